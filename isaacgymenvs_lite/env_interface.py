"""What agents, players and measurements use of a task: Protocols, so that no class is inherited.

A task of another project fits if it has the members; it imports nothing from here. `require` checks
them once, when an agent or a player is made. N is the number of environments.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, TypeGuard, TypeVar

import gymnasium
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.motion_lib import MotionLib


class StepListener(Protocol):
    """Called after each control step: a video writer, a window. One of `VecTask.listeners`.

    It reads the task and changes nothing in it, except that a viewer passes keys to `on_key`. If it
    has a true attribute `keeps_playing`, a player goes on after its last episode.
    """

    def after_step(self) -> None:
        """A control step was made; the episodes that ended in it are not reset yet."""

    def render(self) -> None:
        """Render the current state: `VecTask.render` was called."""

    def close(self) -> None:
        """Finish and release everything; a second call does nothing."""


class Env(Protocol):
    """A task that resets its episodes on request, as `evaluation.evaluate` plays it."""

    num_envs: int
    """N."""
    rl_device: Any
    """Device of observations, rewards and dones."""
    progress_buf: Tensor
    """(N,) control steps of the running episodes."""

    def reset(self) -> dict[str, Tensor]:
        """Reset all environments; return {"obs": (N, O)}."""
        ...

    def reset_done(self) -> tuple[dict[str, Tensor], Tensor]:
        """Reset the environments whose episodes ended; return observations, and ids (n,)."""
        ...

    def step(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, dict[str, Any]]:
        """Make a control step; return observations, rewards (N,), dones (N,) and infos."""
        ...


class AMPObsEnv(Protocol):
    """A task whose `infos["amp_obs"]` (N, F) show the motion of the last control steps.

    Its `num_amp_obs_steps`, an int, is how many; without it 1 is assumed.
    """

    amp_observation_space: gymnasium.spaces.Box
    """Shape (F,) of an AMP observation."""


class AMPEnv(AMPObsEnv, Protocol):
    """A task that AMP can learn: it also has reference motions.

    `infos["terminate"]` (N,) is 1 where an episode ended by a failure. `infos["off_clip"]` (N,)
    bool, which a task may leave out, is true where that was no fall: the motion left its clip.
    """

    def fetch_amp_obs_demo(self, num_samples: int) -> Tensor:
        """Return AMP observations (num_samples, F) of the reference motions."""
        ...


@dataclass(frozen=True)
class TrackingDemo:
    """Moments of the reference motions, for the actor to learn.

    Attributes:
        obs: (n, O) observations.
        actions: (n, A) that make the drives go on as the clips do, within +-1.
        amp_obs: (n, F) AMP observations of the same moments.
    """

    obs: Tensor
    actions: Tensor
    amp_obs: Tensor


class TrackingEnv(AMPEnv, Protocol):
    """A task that shows how to follow its reference motions, for a warm start."""

    def fetch_tracking_demo(self, num_samples: int, with_goal: bool = True) -> TrackingDemo | None:
        """Return n moments, None if they are not known; called before a reset of all episodes.

        Observations without the goal lack their last `get_task_obs_size()` entries.
        """
        ...


class SkillEnv(AMPEnv, Protocol):
    """A task for policies that act under skill latents (GenAMP, ASE)."""

    num_envs: int
    """N."""
    progress_buf: Tensor
    """(N,) control steps of the running episodes."""


class ClipSkillEnv(SkillEnv, Protocol):
    """A task for skills that are encoded from its reference motions."""

    def amp_obs_of(self, env_ids: Tensor) -> Tensor:
        """Return the current AMP observations (n, F) of environments (n,)."""
        ...

    def fetch_amp_obs_demo_pairs(self, num_samples: int) -> Tensor:
        """Return AMP observations (num_samples, 2, F) of two moments of the same clip each."""
        ...


class ClipKeepingEnv(ClipSkillEnv, Protocol):
    """A task that can end episodes which leave the clip that they started in."""

    def keep_to_clips(self, env_ids: Tensor) -> None:
        """From here on, episodes (n,) that started in a clip fail if they leave it."""

    def leave_clips(self, env_ids: Tensor) -> None:
        """From here on, episodes (n,) may do something else."""


class ClipWindowsEnv(AMPObsEnv, Protocol):
    """A task in whose reference motions `SkillProbe` looks for what a policy shows."""

    num_amp_obs_steps: int
    """Control steps of an AMP observation."""
    progress_buf: Tensor
    """(N,) control steps of the running episodes."""
    motion_lib: MotionLib
    """The reference motions."""

    def windows_of_clips(self) -> list[Tensor]:
        """Return the AMP observations (n, F) along each clip."""
        ...


class HierarchyEnv(AMPObsEnv, Protocol):
    """A task for a high-level policy over a low-level controller (HRL)."""

    observation_space: gymnasium.spaces.Box
    """Shape (O,) of an observation, the task's features included."""
    action_space: gymnasium.spaces.Box
    """Shape (A,) and limits of the low-level controller's actions."""
    reset_buf: Tensor
    """(N,) 1 where the next `reset_done` starts a new episode; the agent writes into it."""

    def get_task_obs_size(self) -> int:
        """Return how many entries of an observation, the last ones, describe the task."""
        ...


def failures(dones: Tensor, infos: dict[str, Any]) -> Tensor:
    """Return (N,) 1 where an episode ended by a failure: no future to bootstrap from.

    Args:
        dones: (N,) 1 where an episode ended.
        infos: of the step; without `terminate` and `time_outs` (N,) every end is a failure.
    """
    if "terminate" in infos:
        return infos["terminate"].to(dones.device)
    if "time_outs" in infos:
        return dones.bool() & ~infos["time_outs"].to(dones.device).bool()
    return dones


def goal_size(env: Any) -> int:
    """Return the number of goal entries that end an observation; 0 without a goal."""
    size_of = getattr(env, "get_task_obs_size", None)
    return 0 if size_of is None else int(size_of())


class GoalEnv(Env, Protocol):
    """A task that measures how far a step was from its goal."""

    def goal_errors(self) -> dict[str, Tensor]:
        """Return errors (N,) of the last step by name, such as `velocity_error_m_s`."""
        ...


class BodyStates(Protocol):
    """A task's `simulation`, as far as measurements read it; B bodies, positions in m."""

    body_names: Any
    """B names."""
    body_pos: Tensor
    """(N, B, 3) in the world frame."""
    body_rot: Tensor
    """(N, B, 4) quaternions xyzw in the world frame."""
    root_states: Tensor
    """(N, 13) position, quaternion xyzw, linear and angular velocity."""
    dof_pos: Tensor
    """(N, D) rad, angles of hinges and rotation vectors of ball joints."""


class ReferenceEnv(Env, Protocol):
    """A task whose motion is compared with its reference motions.

    Its `clip_starts_s` (N,), which it may leave out, are the times of its only clip at which the
    episodes started that end with the clip; None: they go on.
    """

    motion_lib: MotionLib
    """The reference motions."""
    simulation: BodyStates
    """The simulated bodies."""
    dt: float
    """Seconds of a control step."""
    max_episode_length: int
    """Control steps of the longest episode."""
    device: str | torch.device
    """Device of the simulated state."""


E = TypeVar("E")


def diverged_in(infos: Any, device: Any) -> Tensor | None:
    """Return where the simulation diverged in a step, (N,) bool on `device`; None if nowhere.

    Args:
        infos: of the step; `diverged` (N,) bool is of a task that reports it.
        device: of the result.
    """
    diverged = infos.get("diverged") if isinstance(infos, dict) else None
    if not reports_divergence(diverged) or not bool(diverged.any()):
        return None
    return diverged.to(device)


def reports_divergence(diverged: Any) -> TypeGuard[Tensor]:
    """Return whether `VecTask` writes an info of this name: a task may have another."""
    return isinstance(diverged, Tensor) and diverged.ndim == 1 and diverged.dtype == torch.bool


def fits(env: object, contract: type[E]) -> TypeGuard[E]:
    """Return whether `env` has all members of a Protocol of this module."""
    return not _missing_members(env, contract)


def _missing_members(env: object, contract: type) -> list[str]:
    protocols = [cls for cls in reversed(contract.__mro__) if cls.__module__ == __name__]
    members = (name for cls in protocols for name in (*cls.__annotations__, *vars(cls)))
    names = dict.fromkeys(name for name in members if name[0] != "_")
    return [name for name in names if not hasattr(env, name)]


def require(env: Any, contract: type[E], user: str) -> E:
    """Return `env`, once it has all members of a Protocol of this module.

    Args:
        env: the task.
        contract: the Protocol.
        user: what needs it, the first words of the message: `StyleReward`.

    Raises:
        ConfigError: a member is missing; all of them are named.
    """
    if missing := _missing_members(env, contract):
        raise ConfigError(
            f"{user} needs a task with reference motions, such as task=HumanoidAMP;"
            f" {type(env).__name__} has no {', '.join(missing)} (expected is"
            f" isaacgymenvs_lite.env_interface.{contract.__name__})"
        )
    return env
