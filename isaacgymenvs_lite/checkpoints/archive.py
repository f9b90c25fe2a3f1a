"""Reads files of `torch.save`, without torch's unpickler and without running anything.

A pickle is a program that calls what it can name. An allow-list of names alone, as torch's own
restricted reader has, runs no code of a stranger, but the allowed functions receive any arguments:
a file can make tensors that reach beyond their memory or are no plain ones, and claim more memory
than a machine has. So the few names that checkpoints need are placeholders of this module, and
tensors are made afterwards, once their sizes were compared with the bytes in the file: every
returned tensor is dense, on the CPU, and owns its memory.

Both formats of torch are read: archives (since 1.6) and the older pickles in a row.
"""

from __future__ import annotations

import io
import math
import re
import struct
import zipfile
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from isaacgymenvs_lite.utils.limited_pickle import LimitedUnpickler

MAX_FILE_BYTES = 2 * 2**30
"""Largest file that is read; the largest networks here take some ten MB."""

# Of the pickle and the table of contents; a checkpoint has some 50 kB that are not tensors.
_MAX_STRUCTURE_BYTES = 2**20
_MAX_VALUES = 200_000
_MAX_DEPTH = 32
_MAX_TEXT = 100_000
_MAX_DIMENSIONS = 8
# Tensors may share memory (tied weights), but not so that a small file becomes a large model.
_MAX_SHARING = 4
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_VERSION = 1001

_STORAGES = {
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "FloatStorage": torch.float32,
    "DoubleStorage": torch.float64,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "ShortStorage": torch.int16,
    "IntStorage": torch.int32,
    "LongStorage": torch.int64,
    "BoolStorage": torch.bool,
}
_NUMPY_NUMBER = re.compile(r"[<=|]?(f[248]|[iu][1248]|b1)")


class ArchiveError(ValueError):
    """A file is damaged, or larger than it may be; the message is one line."""


class ForbiddenNameError(ArchiveError):
    """A file names something beside tensors and plain containers.

    Attributes:
        name: of the class or function.
    """

    def __init__(self, name: str) -> None:
        super().__init__(f"the file uses {name}")
        self.name = name


def read_archive(path: Path) -> Any:
    """Return the content of a file of `torch.save`, on the CPU.

    Returns:
        Dictionaries (keys are texts and integers), lists, tuples, texts, numbers, None and
        tensors; what is a scalar of numpy in the file is a number.

    Raises:
        ForbiddenNameError: it names anything else, which may be code; nothing was run.
        ArchiveError: it is damaged, or larger than it may be. Damaged files may also raise any
            other exception of a reader.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(0)
        if size > MAX_FILE_BYTES:
            raise ArchiveError(f"a file of {size / 2**30:.1f} GiB")
        is_archive = file.read(4) == b"PK\x03\x04"
        file.seek(0)
        return _read_zip(file, size) if is_archive else _read_legacy(file, size)


def _read_zip(file: BinaryIO, size: int) -> Any:
    metered = _Metered(file, _MAX_STRUCTURE_BYTES)
    with zipfile.ZipFile(metered) as archive:  # type: ignore[arg-type]  # reads and seeks
        members = archive.infolist()
        if any(m.compress_type != zipfile.ZIP_STORED for m in members) or size < sum(
            max(m.file_size, m.compress_size) for m in members
        ):
            raise ArchiveError("its parts are compressed or overlap")
        (pickled,) = (name for name in archive.namelist() if re.fullmatch(r"[^/]+/data\.pkl", name))
        folder = pickled.removesuffix("data.pkl")
        names = set(archive.namelist())
        if f"{folder}byteorder" in names and archive.read(f"{folder}byteorder") != b"little":
            raise ArchiveError("numbers of another byte order")
        content = _Unpickler(io.BytesIO(archive.read(pickled))).load()
        metered.left = size
        return _Resolver(lambda storage: archive.read(f"{folder}data/{storage.key}"), size)(content)


def _read_legacy(file: BinaryIO, size: int) -> Any:
    """Read the five pickles in a row and the memory of the tensors after them."""
    metered = _Metered(file, _MAX_STRUCTURE_BYTES)
    unpickler = _Unpickler(metered)
    if unpickler.load() != _LEGACY_MAGIC or unpickler.load() != _LEGACY_VERSION:
        raise ArchiveError("not written by torch.save")
    unpickler.load()  # properties of the machine that wrote it
    content = unpickler.load()
    metered.left = size
    memory: dict[str, bytes] = {}
    for key in unpickler.load():
        storage = unpickler.storages[str(key)]
        (length,) = struct.unpack("<q", metered.read(8))
        if length != storage.length:
            raise ArchiveError("a tensor's memory of another size")
        memory[key] = metered.read(storage.num_bytes)
    return _Resolver(lambda storage: memory[storage.key], size)(content)


class _Metered:
    """A file of which no more than `left` bytes can be read."""

    def __init__(self, file: BinaryIO, left: int) -> None:
        self._file = file
        self.left = left

    def read(self, size: int = -1) -> bytes:
        content = self._file.read(self.left + 1 if size < 0 else min(size, self.left + 1))
        self.left -= len(content)
        if self.left < 0:
            raise ArchiveError("more structure than a checkpoint has")
        return content

    def readline(self) -> bytes:
        line = self._file.readline(self.left)
        self.left -= len(line)
        return line

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def seekable(self) -> bool:
        return True


# --- placeholders -------------------------------------------------------------------------------


@dataclass(frozen=True)
class _StorageType:
    dtype: torch.dtype


@dataclass(frozen=True)
class _Storage:
    """Placeholder for the memory of tensors."""

    key: str
    dtype: torch.dtype
    length: int

    @property
    def num_bytes(self) -> int:
        return self.length * self.dtype.itemsize


@dataclass(frozen=True)
class _Tensor:
    """Placeholder for a tensor; `offset`, `shape` and `strides` count numbers."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    def __post_init__(self) -> None:
        sizes = (self.shape, self.strides)
        if not isinstance(self.storage, _Storage) or not all(isinstance(s, tuple) for s in sizes):
            raise ArchiveError("a tensor without memory or shape")
        numbers = (self.offset, *self.shape, *self.strides)
        if any(type(n) is not int or not 0 <= n <= MAX_FILE_BYTES for n in numbers):
            raise ArchiveError("a tensor of an impossible shape")
        if len(self.shape) != len(self.strides) or len(self.shape) > _MAX_DIMENSIONS:
            raise ArchiveError("a tensor of an impossible shape")
        steps = zip(self.shape, self.strides, strict=True)
        last = self.offset + sum((size - 1) * stride for size, stride in steps)
        # An expanded tensor has more numbers than its memory holds.
        if self.numel > self.storage.length or (self.numel > 0 and last >= self.storage.length):
            raise ArchiveError("a tensor that is larger than its memory")

    @property
    def numel(self) -> int:
        return math.prod(self.shape)


class _Dictionary(dict[Any, Any]):
    """Placeholder for an OrderedDict; its attributes are dropped."""


class _Dtype:
    """Placeholder for a numpy.dtype."""

    def __init__(self, name: str) -> None:
        self.name = name


@dataclass(frozen=True)
class _Number:
    """Placeholder for a scalar of numpy."""

    value: float


def _make_tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_others: Any) -> _Tensor:
    return _Tensor(storage, offset, shape, strides)


def _make_parameter(data: Any, *_others: Any) -> Any:
    return data


def _make_dictionary(*entries: Any) -> _Dictionary:
    if entries:
        raise ArchiveError("a dictionary that is filled when it is made")
    return _Dictionary()


def _make_dtype(name: Any, *_flags: Any) -> _Dtype:
    if not isinstance(name, str) or not _NUMPY_NUMBER.fullmatch(name):
        raise ArchiveError("a scalar that is no number")
    return _Dtype(name)


def _make_number(dtype: Any, content: Any) -> _Number:
    if not isinstance(dtype, _Dtype) or not isinstance(content, bytes):
        raise ArchiveError("a scalar that is no number")
    return _Number(np.frombuffer(content, np.dtype(dtype.name)).reshape(()).item())


def _encode(text: Any, encoding: Any) -> bytes:
    if not isinstance(text, str) or encoding != "latin1":
        raise ArchiveError("bytes of another encoding")
    return text.encode("latin1")


_NAMES: dict[tuple[str, str], Any] = {
    ("collections", "OrderedDict"): _make_dictionary,
    ("torch._utils", "_rebuild_tensor_v2"): _make_tensor,
    ("torch._utils", "_rebuild_parameter"): _make_parameter,
    ("numpy", "dtype"): _make_dtype,
    ("numpy.core.multiarray", "scalar"): _make_number,  # numpy 1
    ("numpy._core.multiarray", "scalar"): _make_number,
    ("_codecs", "encode"): _encode,
    **{("torch", name): _StorageType(dtype) for name, dtype in _STORAGES.items()},
}


class _Unpickler(LimitedUnpickler):
    """Calls only the functions above, and returns placeholders for tensors and their memory."""

    key_types = (str, int, _Number)
    error = ArchiveError

    def __init__(self, stream: Any) -> None:
        super().__init__(stream, encoding="latin1")
        self.storages: dict[str, _Storage] = {}

    def find_class(self, module: str, name: str) -> Any:
        module = {"__builtin__": "builtins"}.get(module, module)
        try:
            return _NAMES[module, name]
        except KeyError:
            forbidden = re.sub(r"[^\w.]", "?", f"{module}.{name}")[:100]
            raise ForbiddenNameError(forbidden) from None

    def persistent_load(self, pid: Any) -> _Storage:
        kind, storage_type, key, _location, length, *view = pid
        if kind != "storage" or any(view) or not isinstance(storage_type, _StorageType):
            raise ArchiveError("memory of an unknown kind")
        if not isinstance(key, str) or not re.fullmatch(r"\w{1,40}", key):
            raise ArchiveError("memory without a name")
        if type(length) is not int or not 0 <= length <= MAX_FILE_BYTES:
            raise ArchiveError("memory of an impossible size")
        storage = _Storage(key, storage_type.dtype, length)
        if self.storages.setdefault(key, storage) != storage:
            raise ArchiveError("memory of two kinds")
        return storage

    def build(self, instance: Any, state: Any) -> None:
        """Drop the state of a dictionary or a numpy.dtype; nothing else has one."""
        del state
        if not isinstance(instance, (_Dictionary, _Dtype)):
            raise ArchiveError("a state of something that has none")


# --- from placeholders to values ------------------------------------------------------------------


class _Resolver:
    """Replaces the placeholders in nested containers by tensors and numbers.

    Args:
        read: returns the memory of a storage.
        size: of the file in bytes.
    """

    def __init__(self, read: Callable[[_Storage], bytes], size: int) -> None:
        self._read = read
        self._bytes_left = _MAX_SHARING * size
        self._values_left = _MAX_VALUES
        self._memory: dict[str, Tensor] = {}

    def __call__(self, value: Any, depth: int = 0) -> Any:
        self._values_left -= 1
        if self._values_left < 0 or depth > _MAX_DEPTH:
            raise ArchiveError("more values, or deeper ones, than a checkpoint has")
        if isinstance(value, _Tensor):
            return self._tensor(value)
        if isinstance(value, dict):
            return {self._key(k): self(entry, depth + 1) for k, entry in value.items()}
        if isinstance(value, (list, tuple)):
            entries = (self(entry, depth + 1) for entry in value)
            return list(entries) if isinstance(value, list) else tuple(entries)
        return self._scalar(value)

    def _key(self, key: Any) -> Hashable:
        key = self._scalar(key)
        if type(key) not in (str, int):
            raise ArchiveError("a dictionary with other keys than texts and integers")
        return key

    def _scalar(self, value: Any) -> Any:
        value = value.value if isinstance(value, _Number) else value
        if isinstance(value, str) and len(value) <= _MAX_TEXT:
            return value
        if type(value) is int and abs(value) < 2**63:
            return value
        if value is None or type(value) in (bool, float):
            return value
        raise ArchiveError(f"a value of type {type(value).__name__}")

    def _tensor(self, tensor: _Tensor) -> Tensor:
        self._bytes_left -= tensor.numel * tensor.storage.dtype.itemsize
        if self._bytes_left < 0:
            raise ArchiveError("tensors that are larger than the file")
        memory = self._memory_of(tensor.storage)
        if tensor.numel == 0:
            return torch.empty(tensor.shape, dtype=memory.dtype)
        return memory.as_strided(tensor.shape, tensor.strides, tensor.offset).clone(
            memory_format=torch.contiguous_format
        )

    def _memory_of(self, storage: _Storage) -> Tensor:
        if storage.key not in self._memory:
            content = bytearray(self._read(storage))
            if len(content) != storage.num_bytes:
                raise ArchiveError("a tensor's memory of another size")
            if storage.dtype is torch.bool and max(content, default=0) > 1:
                raise ArchiveError("a truth value that is none")
            self._memory[storage.key] = (
                torch.frombuffer(content, dtype=storage.dtype)
                if content
                else torch.empty(0, dtype=storage.dtype)
            )
        return self._memory[storage.key]
