"""Protocols for the members of a task that agents, players and measurements use.

A task of another project can be used if it has these members; it needs no base class of this
project. `require` checks the members once, when an agent or a player is made. N is the number of
environments.
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
    """An entry of `VecTask.listeners`, for example a video writer or a window.

    A listener does not change the task, except that a viewer passes pressed keys to the task's
    `on_key`. If a listener has an attribute `keeps_playing` that is true, a player continues after
    its last episode.
    """

    def after_step(self) -> None:
        """Read the task after a control step; episodes that ended in it are not reset yet."""

    def render(self) -> None:
        """Render the current state when `VecTask.render` is called."""

    def close(self) -> None:
        """Finish all files and release all resources; a second call does nothing."""


class Env(Protocol):
    """A task that resets its episodes on request, for `evaluation.evaluate`."""

    num_envs: int
    rl_device: Any
    """Device of observations, rewards and dones."""
    progress_buf: Tensor
    """(N,) control steps of the running episodes."""

    def reset(self) -> dict[str, Tensor]:
        """Reset all environments; return {"obs": (N, O)}."""
        ...

    def reset_done(self) -> tuple[dict[str, Tensor], Tensor]:
        """Reset the environments whose episodes ended; return observations, and these ids (n,)."""
        ...

    def step(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, dict[str, Any]]:
        """Make a control step; return observations, rewards (N,), dones (N,) and infos."""
        ...


class AMPObsEnv(Protocol):
    """A task whose `infos["amp_obs"]` (N, F) describe the motion of the last control steps.

    The optional attribute `num_amp_obs_steps`, 1 by default, is the number of these steps.
    """

    amp_observation_space: gymnasium.spaces.Box
    """Shape (F,) of an AMP observation."""


class AMPEnv(AMPObsEnv, Protocol):
    """A task that AMP can learn; in addition to AMP observations it has reference motions.

    `infos["terminate"]` (N,) is 1 where an episode ended by a failure. The optional
    `infos["off_clip"]` (N,) bool is true where the failure was a motion that left the clip, and
    false where the failure was a fall.
    """

    def fetch_amp_obs_demo(self, num_samples: int) -> Tensor:
        """Return AMP observations (num_samples, F) of the reference motions."""
        ...


@dataclass(frozen=True)
class TrackingDemo:
    """Observations at n times of the reference motions, with actions for the actor to learn.

    Attributes:
        obs: (n, O) observations.
        actions: (n, A) actions within +-1 with which the drives follow the clips.
        amp_obs: (n, F) AMP observations at the same times.
        reaches_goal: whether the motions reach the goals in `obs`. Otherwise goals are random.
    """

    obs: Tensor
    actions: Tensor
    amp_obs: Tensor
    reaches_goal: bool = False


class TrackingEnv(AMPEnv, Protocol):
    """A task that gives actions along its reference motions, with which a training can begin."""

    def fetch_tracking_demo(self, num_samples: int, with_goal: bool = True) -> TrackingDemo | None:
        """Return a demonstration, or None if unknown; the caller must then reset all episodes.

        If `with_goal` is False, observations lack their last `get_task_obs_size()` entries.
        """
        ...


class SkillEnv(AMPEnv, Protocol):
    """A task for policies that act under skill latents (GenAMP, ASE)."""

    num_envs: int
    progress_buf: Tensor
    """(N,) control steps of the running episodes."""


class ClipSkillEnv(SkillEnv, Protocol):
    """A task for skills whose latents an encoder computes from the reference motions."""

    def amp_obs_of(self, env_ids: Tensor) -> Tensor:
        """Return the current AMP observations (n, F) of environments (n,)."""
        ...

    def fetch_amp_obs_demo_pairs(self, num_samples: int) -> Tensor:
        """Return AMP observations (num_samples, 2, F) at pairs of times in the same clip."""
        ...


class CommandedSkillEnv(ClipSkillEnv, Protocol):
    """A task that rewards characters for the motion that the first entries of latents command.

    A command is shorter than 1, because a latent is a unit vector.
    """

    num_skill_commands: int
    """Number C of values in a command, 0 if the task takes no commands."""

    def fetch_commanded_demos(self, num_samples: int) -> tuple[Tensor, Tensor]:
        """Return AMP observations (n, F) of reference motions, and their commands (n, C)."""
        ...

    def command_skills(self, env_ids: Tensor, commands: Tensor) -> None:
        """Give commands (n, C) to environments (n,)."""
        ...


class ClipKeepingEnv(ClipSkillEnv, Protocol):
    """A task that can end those episodes whose motion leaves their clip."""

    def keep_to_clips(self, env_ids: Tensor) -> None:
        """Let episodes (n,) that started in a clip fail as soon as they leave it."""

    def leave_clips(self, env_ids: Tensor) -> None:
        """Allow episodes (n,) to leave their clip from now on."""


class ClipWindowsEnv(AMPObsEnv, Protocol):
    """A task whose reference motions `SkillProbe` compares with the motions of a policy."""

    num_amp_obs_steps: int
    """Control steps of an AMP observation."""
    progress_buf: Tensor
    """(N,) control steps of the running episodes."""
    motion_lib: MotionLib
    """The reference motions."""

    def windows_of_clips(self) -> list[Tensor]:
        """Return for each clip the AMP observations (n, F) at its steps."""
        ...


class HierarchyEnv(AMPObsEnv, Protocol):
    """A task for a high-level policy over a low-level controller (HRL)."""

    observation_space: gymnasium.spaces.Box
    """Shape (O,) of an observation, including the task's features."""
    action_space: gymnasium.spaces.Box
    """The space of the low-level controller's actions: shape (A,) and limits."""
    reset_buf: Tensor
    """(N,) 1 where the next `reset_done` starts a new episode; the agent writes into it."""

    def get_task_obs_size(self) -> int:
        """Return the number of entries at the end of an observation that describe the task."""
        ...


def failures(dones: Tensor, infos: dict[str, Any]) -> Tensor:
    """Return (N,) 1 where an episode ended by a failure, so that its value is not bootstrapped.

    Args:
        dones: (N,) 1 where an episode ended.
        infos: the step's infos. If they lack `terminate` and `time_outs` (N,), every end is a
            failure.
    """
    if "terminate" in infos:
        return infos["terminate"].to(dones.device)
    if "time_outs" in infos:
        return dones.bool() & ~infos["time_outs"].to(dones.device).bool()
    return dones


def goal_size(env: Any) -> int:
    """Return the number of goal entries at the end of an observation; a task without goal has 0."""
    size_of = getattr(env, "get_task_obs_size", None)
    return 0 if size_of is None else int(size_of())


class GoalEnv(Env, Protocol):
    """A task that measures how far the character misses its goal."""

    def goal_errors(self) -> dict[str, Tensor]:
        """Map names, for example `velocity_error_m_s`, to errors (N,) in the last step."""
        ...


class BodyStates(Protocol):
    """The members of `simulation` that measurements use; there are B bodies, positions are in m."""

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

    If a task has only one clip and its episodes end with the clip, the optional attribute
    `clip_starts_s` (N,) has the times (s) in the clip at which the episodes started. Otherwise
    `clip_starts_s` is None.
    """

    motion_lib: MotionLib
    """The reference motions."""
    simulation: BodyStates
    """The simulated bodies."""
    dt: float
    """Duration of a control step in s."""
    max_episode_length: int
    """Control steps of the longest episode."""
    device: str | torch.device
    """Device of the simulated state."""


E = TypeVar("E")


def diverged_in(infos: Any, device: Any) -> Tensor | None:
    """Return whether each simulation diverged in a step, (N,) bool, or None if none diverged.

    Args:
        infos: the step's infos; some tasks have `diverged` (N,) bool.
        device: device of the result.
    """
    diverged = infos.get("diverged") if isinstance(infos, dict) else None
    if not reports_divergence(diverged) or not bool(diverged.any()):
        return None
    return diverged.to(device)


def reports_divergence(diverged: Any) -> TypeGuard[Tensor]:
    """Return whether an info `diverged` has the type of `VecTask`; other types are ignored."""
    return isinstance(diverged, Tensor) and diverged.ndim == 1 and diverged.dtype == torch.bool


def fits(env: object, contract: type[E]) -> TypeGuard[E]:
    """Return whether `env` has all members of `contract`, a Protocol of this module."""
    return not _missing_members(env, contract)


def _missing_members(env: object, contract: type) -> list[str]:
    protocols = [cls for cls in reversed(contract.__mro__) if cls.__module__ == __name__]
    members = (name for cls in protocols for name in (*cls.__annotations__, *vars(cls)))
    names = dict.fromkeys(name for name in members if name[0] != "_")
    return [name for name in names if not hasattr(env, name)]


def require(env: Any, contract: type[E], user: str) -> E:
    """Check that `env` has all members of a Protocol of this module, and return it.

    Args:
        env: the task.
        contract: the Protocol.
        user: the name of the object that needs the task, for example `StyleReward`, for the
            message.

    Raises:
        ConfigError: members are missing; the message names them.
    """
    if missing := _missing_members(env, contract):
        raise ConfigError(
            f"{user} needs a task with reference motions, such as task=HumanoidAMP;"
            f" {type(env).__name__} has no {', '.join(missing)} (see"
            f" isaacgymenvs_lite.env_interface.{contract.__name__})"
        )
    return env
