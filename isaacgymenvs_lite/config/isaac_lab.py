"""Train files of Isaac Lab: what they have that IsaacGymEnvs' lack."""

from __future__ import annotations

from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite.errors import ConfigError

SECTION = "env"
"""Section of `train.params` with the limits that Isaac Lab's wrapper keeps."""
# Key of the section -> key of task.env.
_LIMITS = {"clip_observations": "clipObservations", "clip_actions": "clipActions"}


def apply_wrapper_limits(cfg: DictConfig) -> None:
    """Let the task keep the limits of `train.params.env`, in place.

    Raises:
        ConfigError: a limit is no positive number.
    """
    section = OmegaConf.select(cfg, f"train.params.{SECTION}")
    if not isinstance(section, DictConfig):
        return
    for key, task_key in _LIMITS.items():
        value = section.get(key)
        if value is None:
            continue
        if not isinstance(value, (int, float)) or isinstance(value, bool) or value <= 0:
            path = f"train.params.{SECTION}.{key}"
            raise ConfigError(f"{path}: got {value!r}, expected a number above 0")
        OmegaConf.update(cfg, f"task.env.{task_key}", float(value), force_add=True)
