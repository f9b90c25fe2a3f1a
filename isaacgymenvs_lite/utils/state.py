"""Reads and restores the state of objects and of random generators, for resumed trainings."""

from __future__ import annotations

import json
import random
from collections import deque
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

State = Any
"""The content of a checkpoint: tensors, numbers, None and texts in lists and dictionaries."""

_NOTHING = object()
_NUMBERS = (bool, int, float)


class Stateful:
    """Mixin: `state_dict()` returns an object's state, `load_state_dict()` restores it.

    The state consists of the attributes that are tensors, arrays, numbers, None, generators,
    objects with these two methods, or lists, tuples and dictionaries of such values. Other
    attributes keep the values that `__init__` gave them.

    Attributes:
        stored: names of the attributes to store; None means all attributes.
        not_stored: names of the attributes that are not stored, in addition to those that base
            classes name.
    """

    stored: ClassVar[tuple[str, ...] | None] = None
    not_stored: ClassVar[tuple[str, ...]] = ()

    def state_dict(self) -> dict[str, State]:
        """Return a copy of the state; its tensors are on the CPU."""
        parts = {n: read_state(value) for n, value in vars(self).items() if self._is_stored(n)}
        return {name: part for name, part in parts.items() if part is not _NOTHING}

    def load_state_dict(self, state: dict[str, State]) -> None:
        """Restore the state of an object that was constructed with the same arguments.

        Tensors of the same shape are written in place, so that views remain views.

        Raises:
            AttributeError, KeyError, RuntimeError, TypeError, ValueError: the state does not fit.
        """
        own = (value.device for value in vars(self).values() if isinstance(value, Tensor))
        device = next(own, torch.device("cpu"))  # device of tensors that do not exist yet
        for name, part in state.items():
            if not self._is_stored(name):
                raise ValueError(f"{type(self).__name__}.{name} is not stored")
            setattr(self, name, write_state(getattr(self, name, None), part, device))
        for name, part in state.items():
            value = getattr(self, name)
            # Two attributes that were the same tensor may have become two tensors.
            if isinstance(value, Tensor) and not _is_equal(value, part):
                setattr(self, name, part.to(value.device))

    def _is_stored(self, name: str) -> bool:
        bases = type(self).__mro__
        if any(name in vars(base).get("not_stored", ()) for base in bases):
            return False
        return self.stored is None or name in self.stored


def read_state(value: Any) -> State:
    """Return a copy of a value's state; see `Stateful`."""
    if isinstance(value, (np.number, np.bool_)):
        return value.item()
    if value is None or type(value) in _NUMBERS:
        return value
    if isinstance(value, Tensor):
        return value.detach().cpu().clone(memory_format=torch.contiguous_format)
    if isinstance(value, np.ndarray):
        has_numbers = value.dtype.kind in "bif" or value.dtype == np.uint8
        return torch.from_numpy(value.copy()) if has_numbers else _NOTHING
    if isinstance(value, torch.Generator):
        return value.get_state()
    if isinstance(value, np.random.Generator):
        return json.dumps(value.bit_generator.state, default=np.ndarray.tolist)
    if isinstance(value, random.Random):
        return json.dumps(value.getstate())
    if isinstance(value, dict):
        # torch's safe loader refuses keys that are objects.
        parts = {k: read_state(part) for k, part in value.items() if type(k) in (str, int)}
        return {key: part for key, part in parts.items() if part is not _NOTHING}
    if isinstance(value, (list, tuple, deque)):
        items = [read_state(item) for item in value]
        return _NOTHING if any(item is _NOTHING for item in items) else items
    return value.state_dict() if hasattr(value, "load_state_dict") else _NOTHING


def write_state(value: Any, state: State, device: torch.device | str) -> Any:
    """Write a state into a value where possible, and return the restored value.

    Args:
        value: a value of the same type as the value that was read. If `value` is None and the state
            is a tuple, `value` is a cache and stays None.
        state: the result of `read_state`.
        device: device of tensors that do not exist yet.

    Raises:
        AttributeError, KeyError, RuntimeError, TypeError, ValueError: the state does not fit.
    """
    if isinstance(value, torch.Generator):
        value.set_state(state)
    elif isinstance(value, np.random.Generator):
        value.bit_generator.state = json.loads(state)
    elif isinstance(value, random.Random):
        value.setstate(_python_state(state))
    elif isinstance(state, Tensor) and (value is None or isinstance(value, (Tensor, np.ndarray))):
        return _written_tensor(value, state, device)
    elif hasattr(value, "load_state_dict"):
        value.load_state_dict(state)
    elif isinstance(value, dict) and isinstance(state, dict):
        for key, part in state.items():
            missing = [] if isinstance(part, list) else None
            value[key] = write_state(value.get(key, missing), part, device)
    elif isinstance(value, (list, tuple, deque)) and isinstance(state, list):
        former = value if len(value) == len(state) else [None] * len(state)
        items = [write_state(*pair, device) for pair in zip(former, state, strict=True)]
        if isinstance(value, list):
            value[:] = items
        elif isinstance(value, deque):
            return deque(items, value.maxlen)
        else:
            return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    elif state is None or type(state) in _NUMBERS:
        if value is not None and not isinstance(value, (Tensor, tuple, np.generic, *_NUMBERS)):
            raise TypeError(f"{state} in place of a {type(value).__name__}")
        return state
    elif value is not None:
        raise TypeError(f"a {type(state).__name__} in place of a {type(value).__name__}")
    return value


def read_generators() -> State:
    """Return the states of the global random generators of Python, NumPy and torch."""
    numpy_state = np.random.get_state(legacy=False)
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else []
    return {
        "python": json.dumps(random.getstate()),
        "numpy": json.dumps(numpy_state, default=np.ndarray.tolist),
        "torch": torch.get_rng_state(),
        "cuda": list(cuda),
    }


def write_generators(state: State) -> None:
    """Restore the global random generators.

    Raises:
        KeyError, RuntimeError, TypeError, ValueError: `read_generators` did not return the state.
    """
    random.setstate(_python_state(state["python"]))
    np.random.set_state(json.loads(state["numpy"]))
    torch.set_rng_state(state["torch"])
    if state["cuda"] and len(state["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(state["cuda"])


def _python_state(text: str) -> Any:
    version, numbers, gauss = json.loads(text)
    return version, tuple(numbers), gauss


def _written_tensor(value: Any, state: Tensor, device: torch.device | str) -> Any:
    if value is None:
        return state.to(device, copy=True)
    if isinstance(value, np.ndarray):
        if value.shape != tuple(state.shape):
            return state.numpy().astype(value.dtype)
        value[...] = state.numpy()
        return value
    if (value.shape, value.dtype) != (state.shape, state.dtype):
        return state.to(value.device, copy=True)
    with torch.inference_mode():  # the tensor may have been made in this mode
        return value.copy_(state)


def _is_equal(value: Tensor, state: Tensor) -> bool:
    return torch.equal(value.cpu().nan_to_num(), state.nan_to_num())
