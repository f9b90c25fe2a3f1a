"""Finds the folders of the configuration and of the assets, and reads paths that a user gives.

In a checkout the folders are `<repository>/cfg` and `<repository>/assets`; an installed wheel
carries them inside the package. The working directory plays no part.
"""

from __future__ import annotations

import os
from pathlib import Path

from isaacgymenvs_lite.errors import ConfigError

_PACKAGE_DIR = Path(__file__).resolve().parent


PARTS = ("Classic", "HumanoidRandomization", "RobotRandomization", "ClassicPPO", "ClassicSAC")
"""Files of cfg/ that others include, and that are no task or training by themselves."""


def cfg_dir() -> Path:
    """Return the folder that holds config.yaml, task/, train/ and pbt/."""
    return _data_dir("cfg", marker="config.yaml")


def assets_dir() -> Path:
    """Return the folder that holds mjcf/ and amp/motions/."""
    return _data_dir("assets", marker="mjcf")


def shipped_policies_dir() -> Path:
    """Return the folder of the policies that come with the project."""
    return assets_dir() / "policies"


def shipped_policies() -> dict[str, Path]:
    """Return the shipped policies, name -> file, in the order of their names."""
    return {path.stem: path for path in sorted(shipped_policies_dir().glob("*.pth"))}


def user_path(given: str | Path) -> Path:
    """Return a path that a user gives, with `~` and `~name` replaced by the home folder.

    Raises:
        ConfigError: there is no such home folder.
    """
    try:
        return Path(given).expanduser()
    except RuntimeError as error:
        home = Path(given).parts[0]
        raise ConfigError(
            f"{given}: no home folder of '{home}' is known; give the whole path"
        ) from error


def check_working_folder() -> None:
    """Check that the working folder exists: without it torch ends the process while it loads.

    Raises:
        ConfigError: somebody has removed it.
    """
    try:
        os.getcwd()
    except FileNotFoundError as error:
        raise ConfigError("the working folder was removed; change to one that exists") from error


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
