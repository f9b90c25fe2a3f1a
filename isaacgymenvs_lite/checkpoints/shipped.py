"""Lists the shipped policies; imports nothing heavy."""

from __future__ import annotations

from pathlib import Path

from isaacgymenvs_lite.paths import assets_dir


def shipped_policies_dir() -> Path:
    """Return the folder of the policies that come with the project."""
    return assets_dir() / "policies"


def shipped_policies() -> dict[str, Path]:
    """Return the shipped policies, name -> file, in the order of their names."""
    return {path.stem: path for path in sorted(shipped_policies_dir().glob("*.pth"))}
