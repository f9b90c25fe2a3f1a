"""Reads pickled dictionaries of clips (`.npy`, `.pkl`) without running code from the file.

A pickle can call any function by its name. This module maps the names that occur in clips to its
own functions and classes, and refuses all other names. numpy's classes are also replaced, because
they trust the memory layout that a file describes. A joblib file is a pickle, possibly compressed,
in which the bytes of each array follow its description.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.formats.files import reading

_EXPECTED = "poselib clip (.npy of one pickled SkeletonMotion)"
_OBJECT_DTYPE = "O8"
# First bytes of joblib files that are compressed by zlib or gzip.
_COMPRESSED, _ZLIB_OR_GZIP = (b"x", b"\x1f\x8b"), 32 + zlib.MAX_WBITS


def load_object_npy(path: str | Path) -> Any:
    """Return the pickled object in a `.npy` file.

    The object consists of containers, strings, numbers and numpy arrays. Raises MotionFileError if
    the file is damaged, or names other functions or classes.
    """
    with reading(path, _EXPECTED), Path(path).open("rb") as stream:
        is_first_version = np.lib.format.read_magic(stream) == (1, 0)
        shape, _, dtype = (
            np.lib.format.read_array_header_1_0(stream)
            if is_first_version
            else np.lib.format.read_array_header_2_0(stream)
        )
        if dtype != np.dtype(object) or shape != ():
            raise MotionFileError(
                f"{path}: holds an array of {dtype} of shape {shape}, expected a {_EXPECTED}"
            )
        (content,) = _Unpickler(stream, path).load().objects
        return _plain(content)


def load_pickle(path: str | Path, expected: str) -> Any:
    """Return the object in a pickle file; see `load_object_npy`.

    `expected` is the name of the file's format for error messages.
    """
    with reading(path, expected):
        content = Path(path).read_bytes()
        if content.startswith(_COMPRESSED):
            content = zlib.decompress(content, _ZLIB_OR_GZIP)
        return _plain(_Unpickler(io.BytesIO(content), path).load())


class _Dtype:
    """Replaces numpy.dtype, for arrays of numbers, strings and objects."""

    order = "="

    def __init__(self, name: str, *_flags: Any) -> None:
        self.name = name

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = state[1]

    def values(self, content: bytes) -> npt.NDArray[Any]:
        """Return the values (N,) in raw bytes; raise ValueError for a dtype of objects."""
        if not re.fullmatch(r"[<>=|]([fiub]\d|U\d+)", self.order + self.name):
            raise ValueError(f"an array of type '{self.order}{self.name}'")
        return np.frombuffer(content, self.order + self.name).copy()


class _Array:
    """Replaces numpy.ndarray; the pickle passes the array's content to `__setstate__`."""

    values: npt.NDArray[Any] | None = None
    objects: list[Any]

    def __init__(self, *_empty: Any) -> None:
        pass

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _version, shape, dtype, is_fortran, content = state
        if dtype.name == _OBJECT_DTYPE and shape == ():
            self.objects = content  # The outermost array of a .npy contains objects.
        else:
            self.values = dtype.values(content).reshape(shape, order="F" if is_fortran else "C")


class _JoblibArray(_Array):
    """Replaces joblib's NumpyArrayWrapper; in the file, the array's bytes come after it."""

    stream: BinaryIO

    def __setstate__(self, state: dict[str, Any]) -> None:
        shape, dtype = state["shape"], state["dtype"]
        if state.get("numpy_array_alignment_bytes") is not None:
            (padding,) = self.stream.read(1)
            self.stream.read(padding)
        size = math.prod(shape) * dtype.values(b"").itemsize
        super().__setstate__((1, shape, dtype, state["order"] == "F", self.stream.read(size)))


class _Unpickler(pickle.Unpickler):
    """Maps names that occur in clips to this module's functions and classes; refuses others."""

    def __init__(self, stream: BinaryIO, path: str | Path) -> None:
        super().__init__(stream)
        self._path = path

        # New functions are made for each file, because a pickle can set attributes of functions.
        def scalar(dtype: _Dtype, content: bytes) -> float | str:
            return dtype.values(content).item()

        def from_buffer(
            content: bytes, dtype: _Dtype, shape: Any, order: Any, axes: Any = None
        ) -> npt.NDArray[Any]:
            values = dtype.values(content)
            if order == "K":  # The array was transposed before it was stored.
                return values.reshape(shape).transpose(axes)
            return values.reshape(shape, order=order)

        self._names: dict[str, Any] = {
            "collections.OrderedDict": dict,
            "numpy.ndarray": None,  # an argument of _reconstruct
            "numpy.dtype": _Dtype,
            "joblib.numpy_pickle.NumpyArrayWrapper": type(
                "_JoblibArray", (_JoblibArray,), {"stream": stream}
            ),
            "numpy.core.multiarray._reconstruct": _Array,
            "numpy.core.multiarray.scalar": scalar,
            "numpy.core.numeric._frombuffer": from_buffer,  # pickle protocol 5
        }

    def find_class(self, module: str, name: str) -> Any:
        known = f"{module}.{name}".replace("numpy._core.", "numpy.core.", 1)  # numpy 2
        if known in self._names:
            return self._names[known]
        raise MotionFileError(
            f"{self._path}: refused, nothing was run: the file imports {module}.{name}, but a clip "
            "needs only numpy arrays; get the clip from a source that you trust"
        )


def _plain(value: Any) -> Any:
    """Replace each `_Array` in nested containers by a numpy array; tuples become lists."""
    if isinstance(value, _Array):
        if value.values is None:
            raise ValueError("an array of objects or an unfinished array")
        return value.values
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return value
