"""Maps the modules of IsaacGymEnvs to the modules of this package, for `alias`.

Names are relative to the published package: `utils.reformat` means `isaacgymenvs.utils.reformat`.
Modules that are in no table have the same name in this package.
"""

from __future__ import annotations

RENAMED: dict[str, str] = {
    **{
        f"utils.{name}": f"isaacgymenvs_compat.{name}"
        for name in (
            *("dr_utils", "reformat", "rlgames_utils", "rna_util"),
            *("torch_jit_utils", "utils", "wandb_utils"),
        )
    },
    "tasks.humanoid_amp": "tasks.amp.humanoid_amp",
    "tasks.amp.utils_amp": "isaacgymenvs_compat.utils_amp",
    "tasks.amp.utils_amp.amp_torch_utils": "isaacgymenvs_compat.torch_jit_utils",
    "tasks.amp.utils_amp.motion_lib": "isaacgymenvs_compat.motion_lib",
    "pbt.pbt": "isaacgymenvs_compat.pbt",
    "train": "isaacgymenvs_compat.train",
}
"""Maps modules of IsaacGymEnvs to modules of this package that have another name."""

STAND_INS: dict[str, str] = {
    **dict.fromkeys(
        ("pbt.experiments", "pbt.launcher"),
        "processes are not started from Python here: start a training once for each policy, with"
        " pbt=pbt_default pbt.policy_idx=0, 1, ... (docs/pbt.md)",
    )
}
"""Maps packages whose names can be imported but not used to the reason, which errors contain."""

ABSENT: dict[str, str] = {
    **dict.fromkeys(
        ("tasks.allegro_kuka", "tasks.dextreme", "tasks.factory", "tasks.industreal"),
        "these tasks are not here yet",
    ),
    "tasks.amp.poselib": (
        "clips in poselib's format are read by isaacgymenvs_lite.motion; isaacgymenvs-lite"
        " convert makes and retargets them"
    ),
    "tasks.amp.utils_amp.data_tree": "data sets of clips are YAML files, docs/motion_formats.md",
    "tasks.amp.utils_amp.gym_util": "it drives Isaac Gym's viewer; docs/watching.md",
    "tasks.amp.utils_amp.logger": "use Python's logging",
}
"""Maps modules without a counterpart to the reason or a replacement; submodules are included."""


def absent_because(module: str) -> str | None:
    """Return why a module has no counterpart, or None if the module has a counterpart."""
    return _below(module, ABSENT)


def stand_in_because(module: str) -> str | None:
    """Return why names of a module can be imported but not used, or None if they can be used."""
    return _below(module, STAND_INS)


def _below(module: str, table: dict[str, str]) -> str | None:
    names = (name for name in table if f"{module}.".startswith(f"{name}."))
    return table.get(next(names, ""))
