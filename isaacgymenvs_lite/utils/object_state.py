"""Reads what an object remembers, and writes it into another one of the same construction.

For a training that goes on in another process. What an object remembers are the tensors, arrays,
numbers and generators in its attributes, so that a user's own task needs no code for it. A class
may say more:

- `not_stored`: names of attributes that do not change, or belong to the process. Those of its bases
  count too.
- `stored`: the only attributes to store, in place of all.
- `stored_state()` and `restore_state(state)`: do both themselves.
"""

from __future__ import annotations

import dataclasses
import json
import random
from collections import deque
from collections.abc import Callable, Collection, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

State = Any
"""Tensors, numbers, None and texts in lists and dictionaries: what a checkpoint may hold."""

_LEFT_OUT = "left out"
_NOTHING = object()
_NUMBERS = (bool, int, float)
# Of arrays that are stored: those that checkpoints hold.
_DTYPES = frozenset(
    ("bool", "uint8", "int8", "int16", "int32", "int64", "float16", "float32", "float64")
)
_TORCH_GENERATOR, _NUMPY_GENERATOR, _PYTHON_GENERATOR = "torch rng", "numpy rng", "python rng"


def read_state(value: Any) -> State:
    """Return what an object, a container, a tensor or a number remembers; tensors are copies.

    Args:
        value: of its attributes, objects of its own package and of this one are read, and modules
            of torch.
    """
    state = _Reader(value).read(value)
    return {} if state is _NOTHING else state


def write_state(value: Any, state: State, device: str | torch.device = "cpu") -> Any:
    """Write what `read_state` returned into an object or a container of the same construction.

    Memory that several tensors share stays shared. A tensor of another shape than the stored one is
    replaced. A container that does not exist yet is left out: it is a cache.

    Args:
        value: as `read_state`.
        state: of an equal one.
        device: of tensors that do not exist yet.

    Returns:
        The value, or what has to take its place: a number, a tuple, a tensor of another shape.

    Raises:
        ValueError, TypeError, KeyError, RuntimeError: the state is of something else.
    """
    written = [value]
    writer = _Writer(value, device)
    writer.write(value, state, partial(written.__setitem__, 0))
    writer.separate_overwritten()
    return written[0]


def read_generators() -> State:
    """Return the states of the generators of random numbers of python, numpy and torch."""
    name, keys, position, has_gauss, gauss = np.random.get_state(legacy=True)
    numpy_state = [torch.from_numpy(np.asarray(keys).astype(np.int64)), position, has_gauss, gauss]
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else []
    return {
        "python": _python_state(random.getstate()),
        "numpy": [str(name), *numpy_state],
        "torch": torch.get_rng_state(),
        "cuda": list(cuda),
    }


def write_generators(state: State) -> None:
    """Set the generators to what `read_generators` returned.

    Raises:
        ValueError, TypeError, KeyError, RuntimeError: it returned something else.
    """
    random.setstate(_python_state_of(state["python"]))
    name, keys, *rest = state["numpy"]
    np.random.set_state((name, keys.numpy().astype(np.uint32), *rest))
    torch.set_rng_state(state["torch"])
    if state["cuda"] and len(state["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(state["cuda"])


# --- which attributes -----------------------------------------------------------------------------


def _package(value: Any) -> str:
    return type(value).__module__.partition(".")[0]


class _Walk:
    """Which objects and attributes are read and written, starting at `root`."""

    def __init__(self, root: Any) -> None:
        self._packages = {_package(root), "isaacgymenvs_lite"} - {"builtins"}
        self._seen: set[int] = set()

    def is_new(self, value: Any) -> bool:
        """Return whether a container or an object was not met before; equal tuples may be one."""
        is_new = isinstance(value, tuple) or id(value) not in self._seen
        self._seen.add(id(value))
        return is_new

    def has_attributes(self, value: Any) -> bool:
        """Return whether an object is one whose attributes are read."""
        is_walked = _package(value) in self._packages or isinstance(value, torch.nn.Module)
        return is_walked and hasattr(value, "__dict__")

    def names(self, value: Any) -> Iterator[str]:
        """Yield the names of an object's attributes that exist."""
        only: Collection[str] | None = getattr(type(value), "stored", None)
        left_out = {
            name for base in type(value).__mro__ for name in base.__dict__.get("not_stored", ())
        }
        yield from (n for n in (vars(value) if only is None else only) if n not in left_out)


def _is_frozen(value: Any) -> bool:
    params = getattr(type(value), "__dataclass_params__", None)
    return dataclasses.is_dataclass(value) and bool(getattr(params, "frozen", False))


# --- reading --------------------------------------------------------------------------------------


class _Reader(_Walk):
    def read(self, value: Any) -> State:
        """Return a value's state, `_NOTHING` if it has none."""
        if value is None or type(value) in _NUMBERS:
            # A larger one fits in no checkpoint.
            return value if type(value) is not int or abs(value) < 2**63 else _NOTHING
        if isinstance(value, Tensor):
            return value.detach().cpu().clone(memory_format=torch.contiguous_format)
        if isinstance(value, np.ndarray):
            return torch.from_numpy(value.copy()) if value.dtype.name in _DTYPES else _NOTHING
        if isinstance(value, np.generic):
            return value.item() if value.dtype.name in _DTYPES else _NOTHING
        generator = _generator_state(value)
        if generator is not None:
            return generator
        return self._read_parts(value) if self.is_new(value) else _NOTHING

    def _read_parts(self, value: Any) -> State:
        if isinstance(value, dict):
            parts = {key: self.read(v) for key, v in value.items() if type(key) in (str, int)}
            return {key: part for key, part in parts.items() if part is not _NOTHING}
        if isinstance(value, (list, tuple, deque)):
            items = [self.read(item) for item in value]
            return [_LEFT_OUT if item is _NOTHING else item for item in items]
        if hasattr(type(value), "stored_state"):
            return value.stored_state()
        if not self.has_attributes(value):
            return _NOTHING
        parts = {name: self.read(getattr(value, name, None)) for name in self.names(value)}
        numbers = (*_NUMBERS, type(None)) if _is_frozen(value) else ()  # settings
        kept = {k: v for k, v in parts.items() if v is not _NOTHING and type(v) not in numbers}
        return kept or _NOTHING


def _generator_state(value: Any) -> State:
    if isinstance(value, torch.Generator):
        return {_TORCH_GENERATOR: value.get_state()}
    if isinstance(value, np.random.Generator):
        # Some of its numbers have 128 bits.
        return {_NUMPY_GENERATOR: json.dumps(value.bit_generator.state, default=np.ndarray.tolist)}
    if isinstance(value, random.Random):
        return {_PYTHON_GENERATOR: _python_state(value.getstate())}
    return None


def _python_state(state: Any) -> State:
    version, numbers, gauss = state
    return [version, torch.tensor(numbers, dtype=torch.int64), gauss]


def _python_state_of(state: State) -> Any:
    version, numbers, gauss = state
    return (version, tuple(numbers.tolist()), gauss)


# --- writing --------------------------------------------------------------------------------------


class _Writer(_Walk):
    def __init__(self, root: Any, device: str | torch.device) -> None:
        super().__init__(root)
        self._device = device
        self._written: list[tuple[Tensor, Tensor, Callable[[Any], None]]] = []

    def write(self, value: Any, state: State, replace: Callable[[Any], None]) -> None:
        """Write a state into a value, or call `replace` with what has to take its place."""
        if isinstance(state, str) and state == _LEFT_OUT:
            return
        if isinstance(state, Tensor):
            self._write_tensor(value, state, replace)
        elif state is None or type(state) in _NUMBERS:
            replace(type(value)(state) if isinstance(value, np.generic) else state)
        elif isinstance(state, dict) and _restore_generator(value, state):
            return
        elif hasattr(type(value), "restore_state"):
            value.restore_state(state)
        elif isinstance(value, dict):
            self._write_dictionary(value, state)
        elif isinstance(value, (list, tuple, deque)):
            self._write_items(value, state, replace)
        elif value is not None:
            if not self.has_attributes(value):
                raise TypeError(f"parts in place of a {type(value).__name__}")
            self._write_attributes(value, state)

    def separate_overwritten(self) -> None:
        """Give tensors memory of their own that shared one with another of other numbers."""
        for tensor, state, replace in self._written:
            if not torch.equal(tensor.cpu().nan_to_num(), state.nan_to_num()):
                replace(state.to(tensor.device))

    def _write_tensor(self, value: Any, state: Tensor, replace: Callable[[Any], None]) -> None:
        if isinstance(value, np.ndarray):
            if value.shape == tuple(state.shape):
                value[...] = state.numpy()
            else:
                replace(state.numpy().astype(value.dtype))
        elif isinstance(value, Tensor) and _kind(value) == _kind(state):
            with torch.inference_mode():  # also where the tensor was made in this mode
                value.copy_(state)
            self._written.append((value, state, replace))
        elif value is None or isinstance(value, Tensor):
            device = self._device if value is None else value.device
            replace(state.clone().to(device))
        else:
            raise TypeError(f"a tensor in place of a {type(value).__name__}")

    def _write_dictionary(self, value: dict[Any, Any], state: State) -> None:
        for key in [key for key in value if key not in state]:
            if isinstance(value[key], Tensor) or type(value[key]) in _NUMBERS:
                del value[key]
        for key, part in state.items():
            if key not in value and isinstance(part, list) and _are_leaves(part):
                value[key] = part
            else:
                self.write(value.get(key), part, partial(value.__setitem__, key))

    def _write_items(self, value: Any, state: State, replace: Callable[[Any], None]) -> None:
        if len(value) == len(state):
            items = list(value)
            for i, part in enumerate(state):
                self.write(items[i], part, partial(items.__setitem__, i))
        else:
            items = list(state)
            if not _are_leaves(items):
                raise ValueError(f"{len(state)} items, expected {len(value)}")
        if all(a is b for a, b in zip(value, items, strict=False)) and len(value) == len(items):
            return
        if isinstance(value, list):
            value[:] = items
        elif hasattr(value, "_fields"):
            replace(type(value)(*items))
        else:
            replace(deque(items, value.maxlen) if isinstance(value, deque) else tuple(items))

    def _write_attributes(self, value: Any, state: State) -> None:
        known = set(self.names(value))
        for name, part in state.items():
            if name not in known and hasattr(value, name):
                raise ValueError(f"{type(value).__name__}.{name} is not stored")
            put = partial(object.__setattr__ if _is_frozen(value) else setattr, value, name)
            self.write(getattr(value, name, None), part, put)


def _kind(tensor: Tensor) -> tuple[torch.Size, torch.dtype]:
    return tensor.shape, tensor.dtype


def _are_leaves(items: list[State]) -> bool:
    return all(isinstance(item, (Tensor, *_NUMBERS)) for item in items)


def _restore_generator(value: Any, state: dict[Any, State]) -> bool:
    """Set a generator, and return whether the value is one."""
    if isinstance(value, torch.Generator):
        value.set_state(state[_TORCH_GENERATOR])
    elif isinstance(value, np.random.Generator):
        value.bit_generator.state = json.loads(state[_NUMPY_GENERATOR])
    elif isinstance(value, random.Random):
        value.setstate(_python_state_of(state[_PYTHON_GENERATOR]))
    else:
        return False
    return True
