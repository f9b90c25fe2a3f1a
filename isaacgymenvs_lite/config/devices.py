"""Names of devices: `cpu`, `cuda`, `cuda:N`."""

from __future__ import annotations

import logging
import re

from isaacgymenvs_lite.errors import DeviceError

log = logging.getLogger(__name__)

_DEVICE = re.compile(r"cpu|cuda(?::(?P<index>\d+))?")
_stand_in_settings: set[str] | None = None


def let_the_cpu_stand_in() -> None:
    """Take the CPU, from now on and in this process, where a GPU is asked for and there is none.

    For scripts that name a GPU and are not edited. One line of the log says so for each setting.
    """
    global _stand_in_settings
    _stand_in_settings = _stand_in_settings or set()


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

    It is `name`, or the CPU where that stands in, see `let_the_cpu_stand_in`.

    Raises:
        DeviceError: it is misspelt, or torch does not see such a GPU.
    """
    index = check_device_name(name, key)
    if index is None:
        return name
    import torch  # here, because it takes a second that a misspelt key should not cost

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count == 0 and _stand_in_settings is not None:
        if key not in _stand_in_settings:
            _stand_in_settings.add(key)
            log.warning("%s=%s: torch sees no GPU on this machine; the CPU is used", key, name)
        return "cpu"
    if count == 0:
        raise DeviceError(f"{key}={name}: torch sees no GPU on this machine; use {key}=cpu")
    if index >= count:
        names = ", ".join(f"cuda:{i}" for i in range(count))
        raise DeviceError(f"{key}={name}: this machine has cpu, {names}; choose one of them")
    return name
