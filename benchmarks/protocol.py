"""Plays a checkpoint by the fixed evaluation protocol and measures its motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from isaacgymenvs_lite.config.resolvers import register_resolvers
from isaacgymenvs_lite.config.staging import read_yaml
from isaacgymenvs_lite.env_factory import seed_everything
from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.evaluation.evaluate import evaluate
from isaacgymenvs_lite.evaluation.pose_error import ImitationResult
from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.paths import cfg_dir
from isaacgymenvs_lite.runner import load_player

T = TypeVar("T")

EPISODES = 32
EPISODE_STEPS = 300
SEED = 1234
"""This seed draws the starts of the episodes, which are the same for every policy."""

IMITATION_SETTINGS = {
    "task.env.episodeLength": EPISODE_STEPS,
    "task.env.stateInit": "Random",
    "task.env.enableEarlyTermination": True,
}
"""Policies that imitate clips are played with these settings (path in the tree -> value)."""


@dataclass(frozen=True)
class Outcome:
    """Measurements of one policy.

    Attributes:
        imitation: pose error, falls, tempo, episode length.
        speed_m_s: mean speed of the root along the ground.
        clip_speed_m_s: mean speed of the root in the reference clips.
        goal_errors: name -> mean error of the task's goal.
    """

    imitation: ImitationResult
    speed_m_s: float
    clip_speed_m_s: float
    goal_errors: dict[str, float]


class SpeedProbe:
    """Measures the speed of the roots along the ground in each environment's first episode.

    Args:
        num_envs: number N of environments.
        dt_s: control step.
    """

    def __init__(self, num_envs: int, dt_s: float) -> None:
        self._dt_s = dt_s
        self._way_m = torch.zeros(num_envs)
        self._steps = torch.zeros(num_envs)
        self._playing = torch.ones(num_envs, dtype=torch.bool)
        self._before: Tensor | None = None

    def step(self, root_pos_w: Tensor, dones: Tensor) -> None:
        """Add a control step.

        Args:
            root_pos_w: (N, 3) m, positions after the step and before resets.
            dones: (N,), nonzero where the episode ends.
        """
        if self._before is not None:
            moved_m = torch.linalg.vector_norm((root_pos_w - self._before)[:, :2], dim=-1)
            self._way_m += moved_m * self._playing
            self._steps += self._playing
        self._before = root_pos_w.clone()
        self._playing &= dones == 0

    def mean_m_s(self) -> float:
        """Return the mean over the environments with at least one step; nan if none has."""
        speeds = self._way_m / (self._steps * self._dt_s)
        speeds = speeds[speeds.isfinite()]
        return speeds.mean().item() if len(speeds) else math.nan


def clip_speed_m_s(motion_lib: MotionLib, dt_s: float) -> float:
    """Return the mean speed of the root along the ground in the clips, sampled every `dt_s`."""
    speeds = []
    for motion_id in range(motion_lib.num_motions()):
        steps = max(1, int(float(motion_lib.get_motion_length([motion_id])) / dt_s))
        ids = torch.full((steps + 1,), motion_id)
        times_s = dt_s * torch.arange(steps + 1, dtype=torch.float64)
        probe = SpeedProbe(1, dt_s)
        for position in motion_lib.get_motion_state(ids, times_s).root_pos.cpu():
            probe.step(position.unsqueeze(0), torch.zeros(1))
        speeds.append(probe.mean_m_s())
    return sum(speeds) / len(speeds)


def evaluate_checkpoint(
    checkpoint: Path,
    seed: int = SEED,
    num_threads: int = 1,
    overrides: tuple[str, ...] = (),
    episodes: int = EPISODES,
) -> Outcome:
    """Measure the imitation of a checkpoint with the settings of its run; see `play_checkpoint`.

    Args:
        checkpoint: a file in the folder nn/ of a run folder.
        seed: seed of the episodes' starts.
        num_threads: threads of physics and networks.
        overrides: settings with precedence over all others, `key=value`.
        episodes: number of episodes, one in each environment.
    """
    return play_checkpoint(
        checkpoint,
        _measure_imitation,
        {**IMITATION_SETTINGS, "num_envs": episodes, "task.env.numEnvs": episodes},
        seed,
        num_threads=num_threads,
        overrides=overrides,
    )


def play_checkpoint(
    checkpoint: Path,
    measure: Callable[[Any, Any], T],
    fixed: Mapping[str, Any],
    seed: int = SEED,
    *,
    num_threads: int = 1,
    overrides: tuple[str, ...] = (),
) -> T:
    """Play a checkpoint with the settings of its run and of the protocol.

    Args:
        checkpoint: a file in the folder nn/ of a run folder.
        measure: called with the player and the task; returns the measurement.
        fixed: settings of this kind of measurement, path in the tree -> value.
        seed: seed of the episodes' starts.
        num_threads: threads of physics and networks.
        overrides: settings with precedence over all others, `key=value`.

    Raises:
        UserError: the checkpoint or the run's settings cannot be used.
    """
    cfg = _protocol_config(checkpoint, num_threads, {"seed": seed, **fixed}, overrides)
    with load_player(cfg) as player:
        seed_everything(seed)  # making the player drew random values
        return measure(player, player.env)


def _protocol_config(
    checkpoint: Path, num_threads: int, fixed: Mapping[str, Any], overrides: tuple[str, ...]
) -> DictConfig:
    register_resolvers()
    file = checkpoint.absolute().parent.parent / "config.yaml"
    if not file.is_file():
        raise CheckpointError(
            f"{checkpoint}: no config.yaml in {file.parent}; expected a checkpoint in the folder nn"
            " of a run folder of train.py"
        )
    # The run's config.yaml may be older than some keys of cfg/config.yaml.
    root = read_yaml(cfg_dir() / "config.yaml")
    for key in ("defaults", "hydra"):
        root.pop(key, None)
    cfg = OmegaConf.merge(root, read_yaml(file))
    assert isinstance(cfg, DictConfig)
    protocol = {
        "test": True,
        "checkpoint": str(checkpoint),
        "multi_gpu": False,
        "num_threads": num_threads,
        "max_iterations": "",
        "wandb_activate": False,
        "train.params.torch_threads": num_threads,
        "train.params.config.player.deterministic": True,
        **fixed,
    }
    for key, value in protocol.items():
        OmegaConf.update(cfg, key, value, force_add=True)
    cfg.merge_with_dotlist(list(overrides))
    return cfg


def _measure_imitation(player: Any, env: Any) -> Outcome:
    if not hasattr(env, "motion_lib"):
        raise ConfigError(
            f"task={env.cfg['name']}: the task has no reference motions; measure its policies with"
            " python -m benchmarks.returns"
        )
    speed = SpeedProbe(env.num_envs, env.dt)
    result = evaluate(
        env,
        player.act,
        env.num_envs,
        on_step=lambda dones, _: speed.step(env.simulation.root_states[:, :3].cpu(), dones.cpu()),
    )
    assert result.imitation is not None  # the task has reference motions
    clips_m_s = clip_speed_m_s(env.motion_lib, env.dt)
    return Outcome(result.imitation, speed.mean_m_s(), clips_m_s, result.goal_errors)
