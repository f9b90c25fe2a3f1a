"""Checks names of devices: `cpu`, `cuda`, `cuda:N`."""

from __future__ import annotations

import logging
import re

from isaacgymenvs_lite.errors import DeviceError

log = logging.getLogger(__name__)

_DEVICE = re.compile(r"cpu|cuda(?::(?P<index>\d+))?")
# Settings for which the log has said so; None: a missing GPU is an error.
_fallback_keys: set[str] | None = None


def allow_cpu_fallback(allowed: bool = True) -> None:
    """Use the CPU, from now on and in this process, in place of a GPU that does not exist.

    For scripts that name a GPU and are not edited. The log has one line for each setting.

    Args:
        allowed: False makes a missing GPU an error again.
    """
    global _fallback_keys
    _fallback_keys = (_fallback_keys or set()) if allowed else None


def check_device_name(name: str, key: str) -> int | None:
    """Return the index of the GPU that `name`, the value of the setting `key`, means; None: cpu.

    Raises:
        DeviceError: it is misspelt.
    """
    match = _DEVICE.fullmatch(str(name))
    if match is None:
        raise DeviceError(f"{key}={name}: expected cpu, cuda or cuda:N, for example cuda:0")
    return None if name == "cpu" else int(match["index"] or 0)


def check_device(name: str, key: str) -> str:
    """Return the device of this machine that `name`, the value of the setting `key`, means.

    It is `name`, or the CPU after `allow_cpu_fallback`.

    Raises:
        DeviceError: it is misspelt, or torch does not see such a GPU.
    """
    index = check_device_name(name, key)
    if index is None:
        return name
    import torch  # imported late: it takes a second

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count == 0 and _fallback_keys is not None:
        if key not in _fallback_keys:
            _fallback_keys.add(key)
            log.warning("%s=%s: torch sees no GPU on this machine; the CPU is used", key, name)
        return "cpu"
    if count == 0:
        raise DeviceError(f"{key}={name}: torch sees no GPU on this machine; use {key}=cpu")
    if index >= count:
        names = ", ".join(f"cuda:{i}" for i in range(count))
        raise DeviceError(f"{key}={name}: this machine has cpu, {names}; choose one of them")
    return name
