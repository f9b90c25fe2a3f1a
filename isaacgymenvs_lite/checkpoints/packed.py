"""Packs policies into small checkpoints, which contain the settings that are needed to play them.

A full checkpoint can be played only with config.yaml of its run folder, and most of it is the
optimiser's state. A packed policy is one small file with the model, the normaliser of AMP
observations, and the `PolicyInfo` under the key `policy`. A packed policy is loaded like any
checkpoint.
"""

from __future__ import annotations

import copy
import dataclasses
import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.checkpoints.files import load_checkpoint, write_atomically
from isaacgymenvs_lite.checkpoints.llc_reference import LLC_KEY, shipped_reference
from isaacgymenvs_lite.checkpoints.run_config import (
    read_run_config,
    run_config_file,
    units_of_config,
    units_of_model,
)
from isaacgymenvs_lite.errors import CheckpointError, ConfigError, MotionFileError
from isaacgymenvs_lite.motion.formats.deepmimic import PREFIX, find_in_package, is_package_name
from isaacgymenvs_lite.motion.loader import (
    shipped_motions,
    shipped_motions_dir,
    shipped_robot_motions,
    shipped_robot_motions_dir,
)
from isaacgymenvs_lite.paths import shipped_policies
from isaacgymenvs_lite.schema import leaves, read_section, select, setting

log = logging.getLogger(__name__)

POLICY_KEY = "policy"
"""Key under which a packed policy stores its `PolicyInfo`; other checkpoints do not have this
key."""
# These entries of a checkpoint are used by players.
_PLAYED = ("model", "amp_input_mean_std", "env_state")
_CONFIG = "train.params.config"
_CLIP = "task.env.motion_file"
# To play a policy, these sections and keys must have the values of the training.
_NEEDED = (
    *("task.env", "task.sim"),
    *(f"train.params.{section}" for section in ("algo", "model", "network")),
    *(f"{_CONFIG}.normalize_{what}" for what in ("input", "value", "amp_input")),
    *(f"{_CONFIG}.{key}" for key in ("amp_obs_steps", "disc_reward", "disc_reward_scale")),
    *(f"{_CONFIG}.{key}" for key in ("enc_reward_scale", "clip_latents")),
    *(f"{_CONFIG}.latent_{what}" for what in ("dim", "steps_min", "steps_max")),
    # A shipped low-level policy contains its settings, and `llc_config` is therefore not needed.
    f"{_CONFIG}.llc_steps",
)
# The following keys are in these sections, but are not needed to play a policy.
_NOT_NEEDED = (
    *("task.env.numEnvs", "task.env.episodeLength", "task.env.envSpacing"),
    *("task.env.cameraFollow", "task.env.enableDebugVis"),
    *("task.sim.use_gpu_pipeline", "task.sim.physx"),
)
# These settings are specific to the machine of the training.
_NOT_RECORDED = ("name", "full_experiment_name", "train_dir", "print_stats", "multi_gpu")


@dataclass(frozen=True, kw_only=True)
class PolicyInfo:
    """Task, settings and origin of a packed policy; the policy's file contains them.

    Attributes:
        task: name of the policy's task.
        clip: value of `task.env.motion_file` (the reference motion), or '' for a task without it.
        units: sizes of the networks' hidden layers, {"mlp": [...], "disc": [...]}.
        frames: number of environment steps in the training.
        epochs: number of epochs in the training.
        settings: all settings that are needed to play the policy, by their paths in the
            configuration.
        training: section `train.params.config` of the training, as information for users.
    """

    task: str = setting()
    clip: str = setting()
    units: dict[str, list[int]] = setting()
    frames: int = setting(minimum=0)
    epochs: int = setting(minimum=0)
    settings: dict[str, Any] = setting()
    training: dict[str, Any] = setting()

    def __str__(self) -> str:
        """Return one line for users."""
        layers = ", ".join(f"{name} {units}" for name, units in self.units.items())
        of_clip = f" of {self.clip}" if self.clip else ""
        return f"{self.task}{of_clip}, {self.frames / 1e6:.1f} M frames, {layers}"

    def missing(self) -> str:
        """Return instructions for installing the policy's clip, or '' if it is installed."""
        if is_package_name(self.clip):
            try:
                find_in_package(self.clip)
            except MotionFileError as error:
                return str(error)
        return ""


def read_policy_info(path: Path) -> PolicyInfo:
    """Read the `PolicyInfo` of a packed policy, or raise CheckpointError."""
    info = load_checkpoint(path).get(POLICY_KEY)
    names = {field.name for field in dataclasses.fields(PolicyInfo)}
    if not isinstance(info, Mapping) or set(info) != names:
        raise CheckpointError(
            f"{path}: is no packed policy of this version; make one with python -m"
            " isaacgymenvs_lite policies pack checkpoint=FILE name=NAME"
        )
    try:
        return read_section(PolicyInfo, info, "policy")
    except ConfigError as error:
        raise CheckpointError(f"{path}: {error}") from error


def shipped_policy_infos() -> dict[str, PolicyInfo]:
    """Return the shipped policies by their names, in alphabetical order."""
    return {name: read_policy_info(path) for name, path in shipped_policies().items()}


def with_packed_settings(params: Mapping[str, Any], state: Mapping[str, Any]) -> dict[str, Any]:
    """Return the section `params` of a train file, with the settings of a packed policy.

    If `state` does not come from a packed policy, `params` is returned unchanged.
    """
    params = copy.deepcopy(dict(params))
    if POLICY_KEY not in state:
        return params
    own: dict[str, Any] = {"network": {}, "config": dict(params["config"])}
    for path, value in state[POLICY_KEY]["settings"].items():
        *sections, key = path.split(".")
        if sections[:2] == ["train", "params"] and sections[2:3] in (["network"], ["config"]):
            place = own
            for section in sections[2:]:
                place = place.setdefault(section, {})
                if not isinstance(place, dict):
                    raise CheckpointError(
                        f"the checkpoint's policy.settings.{path} is below a value, expected below"
                        " a section; use another checkpoint"
                    )
            place[key] = value
    return {**params, **own}


def pack_policy(
    checkpoint: str | Path, name: str, clip: str = "", folder: str | Path | None = None
) -> Path:
    """Pack the policy of a full checkpoint into a new file, and return the file's path.

    Args:
        checkpoint: full checkpoint in the folder nn/ of a run folder.
        name: name of the packed policy. An existing policy with this name is replaced.
        clip: the shipped clip that the policy imitates; '' selects the clip in the run's settings.
        folder: folder of the new file; None selects assets/policies.

    Raises:
        CheckpointError: the checkpoint cannot be used, or the policy needs a low-level controller
            that does not ship with the project.
        ConfigError: config.yaml is missing, the name cannot be used, the clip does not ship with
            the project, or the folder cannot be written.
    """
    if not re.fullmatch(r"[a-z0-9][a-z0-9_-]*", name) or name == "last":
        raise ConfigError(
            f"name={name}: expected lower-case letters, digits, - and _, and not 'last'"
        )
    checkpoint = Path(checkpoint)
    state = load_checkpoint(checkpoint)
    file, model = run_config_file(checkpoint), state["model"]
    if not file.is_file():
        raise ConfigError(
            f"checkpoint={checkpoint}: no config.yaml in {file.parent}; expected a checkpoint in"
            " the folder nn of a run folder of train.py"
        )
    tree = read_run_config(file, model, to_play=True)
    units = units_of_config(tree)
    if (found := units_of_model(model, units)) != units:
        raise CheckpointError(
            f"checkpoint={checkpoint}: its layers are {found}, those of {file} {units}; expected"
            " the config.yaml of its own run"
        )
    settings = {
        path: value
        for section in _NEEDED
        for path, value in leaves(select(tree, section), section)
        if value is not None
        and not any(path == other or path.startswith(f"{other}.") for other in _NOT_NEEDED)
    }
    if _CLIP in settings:
        settings[_CLIP] = _shipped_clip(clip or settings[_CLIP])
    packed = {key: state[key] for key in _PLAYED if state.get(key) is not None}
    if LLC_KEY in state:
        packed[LLC_KEY] = shipped_reference(state[LLC_KEY])
    info = PolicyInfo(
        task=tree["task"]["name"],
        clip=settings.get(_CLIP, ""),
        units=units,
        frames=int(state.get("frame", 0)),
        epochs=int(state.get("epoch", 0)),
        settings=settings,
        training={
            key: value
            for key, value in tree["train"]["params"]["config"].items()
            if isinstance(value, str | int | float | bool) and key not in _NOT_RECORDED
        },
    )
    packed[POLICY_KEY] = dataclasses.asdict(info)
    path = Path(folder or paths.shipped_policies_dir()) / f"{name}.pth"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, packed)
    except OSError as error:
        raise ConfigError(f"cannot write {path} ({error.strerror or error})") from error
    log.info("%s: %s, %.2f MiB", path, info, path.stat().st_size / 2**20)
    return path


def _shipped_clip(clip: str) -> str:
    """Return the name of a shipped clip, or raise a ConfigError for other clips."""
    file = Path(clip)
    if is_package_name(clip):
        return clip
    names = (*shipped_motions(), *shipped_robot_motions())
    ours = file.parent in (Path(), shipped_motions_dir(), shipped_robot_motions_dir())
    if not ours or file.stem not in names:
        choices = f"{', '.join(names)}, {PREFIX}<name>"
        raise ConfigError(
            f"the policy imitates {clip}, which does not ship; give a clip for its demo as"
            f" clip=NAME: {choices}"
        )
    return file.name
