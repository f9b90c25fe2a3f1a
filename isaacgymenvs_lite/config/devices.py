"""Names of devices: `cpu`, `cuda`, `cuda:N`."""

from __future__ import annotations

import re

from isaacgymenvs_lite.errors import DeviceError

_DEVICE = re.compile(r"cpu|cuda(?::(?P<index>\d+))?")


def check_device(name: str, key: str) -> None:
    """Check that `name`, the value of the setting `key`, is a device of this machine.

    Raises:
        DeviceError: it is misspelt, or torch does not see such a GPU.
    """
    match = _DEVICE.fullmatch(str(name))
    if match is None:
        raise DeviceError(f"{key}={name}: expected cpu, cuda or cuda:N, for example cuda:0")
    if name == "cpu":
        return
    import torch  # here, because it takes a second that a misspelt key should not cost

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count == 0:
        raise DeviceError(f"{key}={name}: torch sees no GPU on this machine; use {key}=cpu")
    index = int(match["index"] or 0)
    if index >= count:
        names = ", ".join(f"cuda:{i}" for i in range(count))
        raise DeviceError(f"{key}={name}: this machine has cpu, {names}; choose one of them")
