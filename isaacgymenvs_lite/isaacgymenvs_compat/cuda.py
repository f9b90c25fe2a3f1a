"""Runs scripts that write `device="cuda:0"` on a machine without a GPU."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch.overrides import TorchFunctionMode


class CudaIsCpu(TorchFunctionMode):
    """Makes torch's functions use the CPU, in a `with` statement, if a script names cuda.

    Calls of torch.cuda and calls in other threads do not change. Each call of a torch function
    becomes slower by about the time in which torch adds two small tensors.
    """

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """Call a torch function; its arguments name the CPU in place of a GPU."""
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
    """Return the CPU if `value` is a GPU, or any other value unchanged."""
    if isinstance(value, (str, torch.device)) and str(value).startswith("cuda"):
        return "cpu"
    return value
