"""Finds the folders of the configuration and of the assets, and reads paths that a user gives.

The folders are `<repository>/cfg` and `<repository>/assets` in a checkout; in an installed wheel
both folders are inside the package. The folders do not depend on the working directory.
"""

from __future__ import annotations

import os
from pathlib import Path

from isaacgymenvs_lite.errors import ConfigError

_PACKAGE_DIR = Path(__file__).resolve().parent


PARTS = (
    *("Classic", "Hand", "HandRandomization", "HumanoidRandomization", "RobotRandomization"),
    *("AsymmetricCritic", "ClassicPPO", "ClassicSAC"),
)
"""Files of cfg/ that exist only to be included by other files."""


def cfg_dir() -> Path:
    """Return the folder with config.yaml, task/, train/ and pbt/."""
    return _data_dir("cfg", marker="config.yaml")


def assets_dir() -> Path:
    """Return the folder with mjcf/ and amp/motions/."""
    return _data_dir("assets", marker="mjcf")


def shipped_policies_dir() -> Path:
    """Return the folder of the shipped policies."""
    return assets_dir() / "policies"


def shipped_policies() -> dict[str, Path]:
    """Return a dictionary from names of shipped policies to files, in alphabetical order."""
    return {path.stem: path for path in sorted(shipped_policies_dir().glob("*.pth"))}


def user_path(given: str | Path) -> Path:
    """Return a user's path with `~` and `~name` replaced by the home folder.

    Raises:
        ConfigError: the home folder is unknown.
    """
    try:
        return Path(given).expanduser()
    except RuntimeError as error:
        home = Path(given).parts[0]
        raise ConfigError(
            f"{given}: the home folder of '{home}' is unknown; give the whole path"
        ) from error


def check_working_folder() -> None:
    """Check that the working folder exists, because without it importing torch ends the process.

    Raises:
        ConfigError: the working folder was removed.
    """
    try:
        os.getcwd()
    except FileNotFoundError as error:
        raise ConfigError("the working folder was removed; change to one that exists") from error


def _data_dir(name: str, marker: str) -> Path:
    """Return the data folder `name` inside the package or next to it.

    Raises:
        FileNotFoundError: neither folder contains `marker`; the installation is incomplete.
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
