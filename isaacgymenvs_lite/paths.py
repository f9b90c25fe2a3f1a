"""Finds the folders of the configuration and of the assets.

In a checkout they are `<repository>/cfg` and `<repository>/assets`; an installed wheel carries them
inside the package. The working directory plays no part.
"""

from __future__ import annotations

from pathlib import Path

_PACKAGE_DIR = Path(__file__).resolve().parent


def cfg_dir() -> Path:
    """Return the folder that holds config.yaml, task/, train/ and pbt/."""
    return _data_dir("cfg", marker="config.yaml")


def assets_dir() -> Path:
    """Return the folder that holds mjcf/ and amp/motions/."""
    return _data_dir("assets", marker="mjcf")


def _data_dir(name: str, marker: str) -> Path:
    """Return the package's own data folder `name`, else the one beside the package.

    Raises:
        FileNotFoundError: neither holds `marker`, which means that the installation is incomplete.
    """
    candidates = (_PACKAGE_DIR / name, _PACKAGE_DIR.parent / name)
    for candidate in candidates:
        if (candidate / marker).exists():
            return candidate
    looked = " and ".join(str(candidate) for candidate in candidates)
    raise FileNotFoundError(
        f"the data folder '{name}' of isaacgymenvs_lite is missing "
        f"(looked for {marker} in {looked}); reinstall the package"
    )
