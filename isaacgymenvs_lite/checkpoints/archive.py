"""Reads files of `torch.save` without running code from them.

rl_games stores its best reward as a numpy scalar, which torch's restricted reader refuses. This
module reads numpy scalars with its own placeholders, because numpy's functions trust a file.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor


class ArchiveError(ValueError):
    """A file is damaged, or holds more than tensors and plain containers."""


def read_archive(path: Path) -> Any:
    """Return the content of a file of `torch.save`, on the CPU.

    The content may have dictionaries, lists, tuples, str, int, float, bool, None and dense tensors
    that do not share memory. numpy scalars become Python scalars.

    Raises:
        ArchiveError: the file is damaged, or holds objects of other types. No code was run.
        OSError: the file cannot be opened.
    """
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Older pickle protocols cause warnings.
        try:
            with torch.serialization.safe_globals(_NUMPY_NAMES):
                return _plain(torch.load(file, map_location="cpu", weights_only=True))
        except ArchiveError:
            raise
        except Exception as error:  # For a damaged file, torch's reader may raise any exception.
            forbidden = re.search(r"GLOBAL ([\w.]+)", str(error))
            if forbidden is None:
                raise ArchiveError("damaged or no checkpoint, nothing was run") from error
            raise _refused(forbidden[1][:100]) from error


def _refused(what: str) -> ArchiveError:
    return ArchiveError(
        f"refused, nothing was run: the file uses {what}, a checkpoint needs only tensors and plain"
        " containers"
    )


def _plain(value: Any) -> Any:
    if isinstance(value, Tensor):
        is_dense = value.layout is torch.strided and not (value.is_nested or value.is_quantized)
        if not is_dense or value.is_meta:
            raise _refused("a tensor that is not dense")
        return value.detach().clone(memory_format=torch.contiguous_format)
    if isinstance(value, dict):
        return {_plain(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    if isinstance(value, tuple):
        return tuple(_plain(entry) for entry in value)
    if value is None or type(value) in (bool, int, float, str):
        return value
    raise _refused(f"a value of type {type(value).__name__}")


class _NumpyDtype:
    """Replaces `numpy.dtype`, because a file must not set the state of numpy's class."""

    def __init__(self, name: str, *_flags: Any) -> None:
        self.dtype = np.dtype(name)

    def __setstate__(self, state: Any) -> None:
        pass


def _numpy_scalar(dtype: _NumpyDtype, content: bytes) -> Any:
    return np.frombuffer(content, dtype.dtype)[0].item()


_NUMPY_NAMES: list[Any] = [
    (_NumpyDtype, "numpy.dtype"),
    (_numpy_scalar, "numpy.core.multiarray.scalar"),  # numpy 1
    (_numpy_scalar, "numpy._core.multiarray.scalar"),
]
