"""Finds the checkout of a task file that is named by its path, and the files in it.

Task files of IsaacGymEnvs, of ASE and of their forks name clips, models and train files by their
paths in their own checkout. `task_checkout` of the configuration is its folder:

    <checkout>/<package>/cfg/task/<task>.yaml       clips in assets/amp/motions (IsaacGymEnvs)
    <checkout>/<package>/cfg/train/<task>PPO.yaml
    <checkout>/cfg/task/<task>.yaml                 the same without a package (this project)
    <checkout>/<package>/data/cfg/<task>.yaml       clips in <package>/data/motions (ASE)

For any other file it is the folder of the file.
"""

from __future__ import annotations

from pathlib import Path

KEY = "task_checkout"
"""Key of the configuration's root: the folder of the checkout, '' for none."""

# Entries in the top folder of a project that a package inside it does not have.
_TOP_OF_A_PROJECT = (".git", "setup.py", "pyproject.toml", "assets")
# ASE's task was an argument of its command line. End of a file's name -> our task.
_TASKS_OF_ASE = {
    "heading": "HumanoidHeading",
    "location": "HumanoidLocation",
    "reach": "HumanoidReach",
    "strike": "HumanoidStrike",
    "getup": "HumanoidASEGetup",
    "getup_test": "HumanoidASEGetup",
    "perturb": "HumanoidPerturb",
    "": "HumanoidASE",
}


def checkout_of(task_file: Path) -> Path:
    """Return the folder of the checkout that a task file belongs to.

    Args:
        task_file: absolute, without symbolic links.
    """
    folder = task_file.parent
    if _is_in_ase(task_file):
        return folder.parents[2]
    if (folder.parent.name, folder.name) != ("cfg", "task"):
        return folder
    package = folder.parents[1]

    def is_top(place: Path) -> bool:
        return any((place / name).exists() for name in _TOP_OF_A_PROJECT)

    return package.parent if is_top(package.parent) and not is_top(package) else package


def train_file_beside(task_file: Path) -> Path | None:
    """Return the train file that goes with a task file by its name, `../train/<task>PPO.yaml`."""
    beside = task_file.parent.with_name("train") / f"{task_file.stem}PPO.yaml"
    return beside if task_file.parent.name == "task" and beside.is_file() else None


def task_of_ase_file(task_file: Path) -> str | None:
    """Return the task of this project that a task file of ASE without a name is for."""
    if not _is_in_ase(task_file):
        return None
    return next(task for end, task in _TASKS_OF_ASE.items() if task_file.stem.endswith(end))


def clip_folders(checkout: Path, name: str) -> list[Path]:
    """Return the folders of a checkout in which a clip or a data set of this name may be.

    A name that leads upwards (`../..`) is searched in the working folder alone.
    """
    if ".." in Path(name).parts:
        return []
    of_ase = [folder / "motions" for folder in _data_folders(checkout)]
    return [checkout, checkout / "assets" / "amp" / "motions", *of_ase]


def model_folders(checkout: Path, root: str) -> list[Path]:
    """Return the folders of a checkout in which a model may be.

    Args:
        checkout: its folder.
        root: `assetRoot` of the task file, '' for none: relative to the tasks in IsaacGymEnvs
            (`../../assets`), to the checkout in ASE (`ase/data/assets`).
    """
    parts = [part for part in Path(root).parts if part != ".."]
    named = [checkout.joinpath(*parts)] if parts and not Path(root).is_absolute() else []
    of_ase = [folder / "assets" for folder in _data_folders(checkout)]
    return list(dict.fromkeys([*named, checkout / "assets", *of_ase]))


def _is_in_ase(task_file: Path) -> bool:
    folder = task_file.parent
    return (folder.parent.name, folder.name) == ("data", "cfg") and len(folder.parents) > 2


def _data_folders(checkout: Path) -> list[Path]:
    """Return `<package>/data` of ASE and its forks."""
    return sorted(cfg.parent for cfg in checkout.glob("*/data/cfg") if cfg.is_dir())
