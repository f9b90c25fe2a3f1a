"""Tensors on a GPU that a machine does not have, for scripts that write `device="cuda:0"`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch.overrides import TorchFunctionMode


class CudaIsCpu(TorchFunctionMode):
    """Makes torch's functions use the CPU where a script names cuda, in a `with` statement.

    Calls of torch.cuda itself are not changed, and neither are other threads. Each call of a torch
    function takes about as much longer as adding two small tensors.
    """

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """Call a torch function, with the CPU in place of a GPU."""
        if func is torch.Tensor.cuda:
            return args[0]
        if func is torch.Tensor.to:
            args = tuple(_device(arg) for arg in args)
        if not kwargs:
            return func(*args)
        if "device" in kwargs:
            kwargs = {**kwargs, "device": _device(kwargs["device"])}
        return func(*args, **kwargs)


def _device(value: Any) -> Any:
    """Return the CPU for a GPU, and everything else as it is."""
    if isinstance(value, (str, torch.device)) and str(value).startswith("cuda"):
        return "cpu"
    return value
