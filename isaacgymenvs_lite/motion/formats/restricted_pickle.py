"""Reads pickled dictionaries of clips (`.npy`, `.pkl`) without running anything from the file.

A pickle is a program that may call any function it can name: `numpy.load(allow_pickle=True)` runs
any code in the file. Here the names that occur in real clips are replaced by inert classes of this
module, every other name is refused, and the arrays are made afterwards from the raw bytes. The file
never calls a function of numpy. joblib's files, also compressed ones, are pickles with the bytes of
each array after its description.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import MotionFileError, one_line
from isaacgymenvs_lite.motion.formats.files import (
    MAX_BINARY_BYTES,
    check_text,
    read_bytes,
    reading,
)
from isaacgymenvs_lite.utils.limited_pickle import LimitedUnpickler

T = TypeVar("T")

# Numbers, booleans and unicode strings; the second part is the size in bytes (U: in characters).
_PLAIN_DTYPE = re.compile(r"(f[248]|[iu][1248]|b1|U\d{1,4})")
_OBJECT_DTYPE = "O8"
_EXPECTED = "poselib clip (.npy of one pickled SkeletonMotion)"
# How joblib's files begin if they are compressed by zlib or gzip.
_COMPRESSED, _ZLIB_OR_GZIP = (b"x", b"\x1f\x8b"), 32 + zlib.MAX_WBITS
_MIMICKIT_CLASSES = (("anim.motion", "Motion"), ("anim.motion", "LoopMode"))
_MAX_SHARING = 4
_MAX_VALUES = 1_000_000
_MAX_DEPTH = 64


def _checked(value: Any, kind: type[T]) -> T:
    """Return a value of the expected type; the text of any other one may be endless."""
    if not isinstance(value, kind):
        raise ValueError(f"a {type(value).__name__} in place of a {kind.__name__}")
    return value


def _values(content: bytes, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    values = np.frombuffer(content, dtype=dtype)
    if dtype.kind == "U":
        check_text(values)
    return values


class _PickledDtype:
    """Stands for a numpy.dtype: keeps its name and byte order."""

    order = "="

    def __init__(self, name: Any = "", *_flags: Any) -> None:
        self.name = _checked(name, str)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = _checked(state[1], str)

    def resolve(self) -> np.dtype[Any]:
        """Return the dtype; ValueError if it is none of plain numbers or text."""
        if not _PLAIN_DTYPE.fullmatch(self.name) or self.order not in ("<", ">", "=", "|"):
            raise ValueError(f"an array of type '{self.order}{self.name}'")
        return np.dtype(self.order + self.name)


class _PickledArray:
    """Stands for a numpy.ndarray: keeps shape, type and raw content."""

    shape: tuple[int, ...] = ()
    dtype: Any = None
    is_fortran = False
    content: Any = None

    def __init__(self, *_args: Any) -> None:
        pass  # The arguments of numpy's _reconstruct describe an empty array.

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _version, shape, self.dtype, is_fortran, self.content = state
        self.shape = tuple(_checked(size, int) for size in _checked(shape, tuple))
        self.is_fortran = _checked(is_fortran, int) != 0

    def single_object(self) -> Any:
        """Return the item of a 0-d object array; ValueError if it is something else."""
        is_object = isinstance(self.dtype, _PickledDtype) and self.dtype.name == _OBJECT_DTYPE
        if not is_object or self.shape != () or not isinstance(self.content, list):
            raise ValueError("no 0-d array of one object")
        return self.content[0]

    def resolve(self) -> npt.NDArray[Any]:
        """Return the array; ValueError if type, shape and content do not fit together."""
        if not isinstance(self.dtype, _PickledDtype) or not isinstance(self.content, bytes):
            raise ValueError("an array of objects or an unfinished array")
        dtype = self.dtype.resolve()
        # An array whose items have no size, or one without items, can have any shape.
        if not dtype.itemsize or max(self.shape, default=0) > _MAX_VALUES:
            raise ValueError(f"an array of {dtype} of shape {self.shape}")
        if min(self.shape, default=0) < 0 or (
            math.prod(self.shape) * dtype.itemsize != len(self.content)
        ):
            raise ValueError(f"an array of shape {self.shape} in {len(self.content)} bytes")
        order = "F" if self.is_fortran else "C"
        return _values(self.content, dtype).reshape(self.shape, order=order).copy()


class _JoblibArray(_PickledArray):
    """Stands for joblib's NumpyArrayWrapper, whose content follows in the file."""

    def read_content(self, state: Any, read: Callable[[int], bytes]) -> None:
        """Keep shape and type, and read the content."""
        state = _checked(state, dict)
        dtype = _checked(state.get("dtype"), _PickledDtype)
        order = "F" if state.get("order") == "F" else "C"
        shape = tuple(_checked(size, int) for size in _checked(state.get("shape"), tuple))
        if state.get("numpy_array_alignment_bytes") is not None:
            read(*read(1))  # padding
        size = math.prod(shape) * dtype.resolve().itemsize
        self.__setstate__((1, shape, dtype, order == "F", read(max(size, 0))))


def _array_of_buffer(content: Any, dtype: Any, shape: Any, order: Any) -> _PickledArray:
    """Stand for numpy's _frombuffer, by which protocol 5 names an array."""
    if _checked(order, str) not in ("C", "F"):
        raise ValueError("an array whose axes were exchanged; pickle it with protocol 4")
    array = _PickledArray()
    array.__setstate__((1, shape, dtype, order == "F", content))
    return array


class _PickledScalar:
    """Stands for a numpy scalar: keeps type and raw content."""

    def __init__(self, dtype: Any = None, content: Any = None, *_args: Any) -> None:
        self.dtype = dtype
        self.content = content

    def resolve(self) -> float | int | bool | str:
        """Return the Python number or text; ValueError if type and content do not fit."""
        if not isinstance(self.dtype, _PickledDtype) or not isinstance(self.content, bytes):
            raise ValueError("a scalar that is no number")
        values = _values(self.content, self.dtype.resolve())
        if values.size != 1:
            raise ValueError(f"a scalar in {len(self.content)} bytes")
        return values[0].item()


def _make_dictionary(*entries: Any) -> dict[Any, Any]:
    if entries:
        raise ValueError("a dictionary that is filled when it is made")
    return {}


def _allowed_names() -> dict[tuple[str, str], Any]:
    names: dict[tuple[str, str], Any] = {
        ("collections", "OrderedDict"): _make_dictionary,
        ("numpy", "ndarray"): _PickledArray,
        ("numpy", "dtype"): _PickledDtype,
    }
    for module in ("numpy.core.multiarray", "numpy._core.multiarray"):  # numpy 1 and numpy 2
        names[module, "_reconstruct"] = _PickledArray
        names[module, "scalar"] = _PickledScalar
    for module in ("numpy.core.numeric", "numpy._core.numeric"):
        names[module, "_frombuffer"] = _array_of_buffer
    names["joblib.numpy_pickle", "NumpyArrayWrapper"] = _JoblibArray
    return names


class _RestrictedUnpickler(LimitedUnpickler):
    """Resolves the names of real clips to the classes above and refuses all others."""

    _names = _allowed_names()
    dispatch: ClassVar[dict[int, Any]] = dict(LimitedUnpickler.dispatch)

    def __init__(self, stream: io.BytesIO, path: Path) -> None:
        super().__init__(stream)
        self._path = path

    def find_class(self, module: str, name: str) -> Any:
        found = self._names.get((module, name))
        if found is None and (module, name) in _MIMICKIT_CLASSES:
            raise MotionFileError(
                f"{self._path}: is a pickled object of MimicKit's class {name}, as its first "
                "versions wrote it; save it again as a dictionary of fps, loop_mode and frames"
            )
        if found is None:
            raise MotionFileError(
                f"{self._path}: refused, nothing was run: the file imports "
                f"{module}.{name}, but a clip needs only numpy arrays; "
                "get the clip from a source that you trust"
            )
        return found

    def load_bytearray8(self) -> None:
        """Push the content of an array, of protocol 5; pickle makes room for any size it reads."""
        (size,) = struct.unpack("<Q", self.read(8))
        self.append(self.read(size))

    def load_newobj(self) -> None:
        """Push an array of joblib's; other classes are made by functions."""
        arguments, cls = self.stack.pop(), self.stack.pop()
        if cls is not _JoblibArray or arguments != ():
            raise ValueError("an object that is no array")
        self.append(_JoblibArray())

    def load_next_buffer(self) -> None:
        """Refuse an array whose content was not pickled."""
        raise MotionFileError(
            f"{self._path}: names arrays whose content is not in the file (out-of-band buffers); "
            "pickle the clip without buffer_callback"
        )

    dispatch[pickle.BYTEARRAY8[0]] = load_bytearray8
    dispatch[pickle.NEXT_BUFFER[0]] = load_next_buffer
    dispatch[pickle.NEWOBJ[0]] = load_newobj

    def build(self, instance: Any, state: Any) -> None:
        """Give an array or a type its state."""
        if isinstance(instance, _JoblibArray):
            instance.read_content(state, self.read)
            return
        if not isinstance(instance, (_PickledArray, _PickledDtype)):
            raise ValueError("a state of something that has none")
        instance.__setstate__(state)


def load_object_npy(path: str | Path) -> Any:
    """Return the content of a `.npy` file that holds one pickled object.

    Returns:
        Dictionaries, lists, text, numbers and numpy arrays.

    Raises:
        MotionFileError: the file imports a name outside numpy's arrays, is empty or damaged, or
            is no `.npy` file of one object.
    """
    path = Path(path)
    with reading(path, _EXPECTED):
        stream = io.BytesIO(read_bytes(path, MAX_BINARY_BYTES))
        _skip_header(stream, path)
        array = _RestrictedUnpickler(stream, path).load()
        if not isinstance(array, _PickledArray):
            raise ValueError("no numpy array")
        return _Resolver(len(stream.getbuffer())).resolve(array.single_object())


def load_pickle(path: str | Path, expected: str) -> Any:
    """Return the content of a pickle file of plain values and numpy arrays.

    Args:
        path: of the file.
        expected: what the file should be, for the messages.

    Raises:
        MotionFileError: as `load_object_npy`.
    """
    path = Path(path)
    with reading(path, expected):
        content = read_bytes(path, MAX_BINARY_BYTES)
        if not content:
            raise MotionFileError(f"{path}: the file is empty, expected a {expected}")
        if content.startswith(_COMPRESSED):
            content = zlib.decompressobj(_ZLIB_OR_GZIP).decompress(content, MAX_BINARY_BYTES)
        return _Resolver(len(content)).resolve(
            _RestrictedUnpickler(io.BytesIO(content), path).load()
        )


def _skip_header(stream: io.BytesIO, path: Path) -> None:
    """Read the numpy header and check that it announces one object."""
    size = len(stream.getbuffer())
    if size == 0:
        raise MotionFileError(f"{path}: the file is empty, expected a {_EXPECTED}")
    readers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    try:
        version = np.lib.format.read_magic(stream)
        shape, _, dtype = readers[version](stream)
    except (ValueError, KeyError, EOFError) as error:
        raise MotionFileError(
            f"{path}: has no readable numpy header ({size} bytes, {one_line(error)}), "
            f"expected a {_EXPECTED}"
        ) from error
    if dtype != np.dtype(object) or shape != ():
        raise MotionFileError(
            f"{path}: holds an array of {dtype} of shape {shape}, expected a {_EXPECTED}"
        )


class _Resolver:
    """Replaces inert objects in nested containers by the arrays and numbers that they describe.

    Containers and arrays may be named more than once in a file, but not so often that a small file
    becomes a large clip.

    Args:
        size: of the file in bytes.
    """

    def __init__(self, size: int) -> None:
        self._bytes_left = _MAX_SHARING * size
        self._values_left = _MAX_VALUES

    def resolve(self, value: Any, depth: int = 0) -> Any:
        """Return the value; ValueError if it is too large or too deep."""
        self._values_left -= 1
        if self._values_left < 0 or depth > _MAX_DEPTH:
            raise ValueError("more values, or deeper ones, than a clip has")
        if isinstance(value, _PickledArray):
            self._bytes_left -= len(value.content or b"")
            if self._bytes_left < 0:
                raise ValueError("arrays that are larger than the file")
            return value.resolve()
        if isinstance(value, _PickledScalar):
            return value.resolve()
        if isinstance(value, dict):
            return {key: self.resolve(item, depth + 1) for key, item in value.items()}
        if isinstance(value, (list, tuple)):
            return [self.resolve(item, depth + 1) for item in value]
        return value
