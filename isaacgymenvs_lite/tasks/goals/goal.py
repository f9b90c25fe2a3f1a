"""The interface between a task whose character imitates clips and its goal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.markers import Arrow, Colour, Marker, arrow_on_ground
from isaacgymenvs_lite.schema import keys_of, read_section, setting
from isaacgymenvs_lite.simulation.backend import SimulationBackend
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.utils.state import Stateful


@dataclass(frozen=True)
class GoalSettings:
    """Keys of `task.env` that every goal reads."""

    enable_task_obs: bool = setting(True, key="enableTaskObs")
    clip_share: float = setting(0.0, key="clipCommandShare", minimum=0, maximum=1)


class ClipsAhead(NamedTuple):
    """What n clips do at the T times `Goal.look_ahead_s` from a moment.

    Attributes:
        root_states: (n, T, 13).
        body_pos_w: name of a key body -> positions (n, T, 3) m.
    """

    root_states: Tensor
    body_pos_w: Mapping[str, Tensor]

    def rows(self, chosen: Tensor) -> ClipsAhead:
        """Return the rows of a mask (n,)."""
        body_pos_w = {name: pos[chosen] for name, pos in self.body_pos_w.items()}
        return ClipsAhead(self.root_states[chosen], body_pos_w)


class Goal(Stateful):
    """Base class of all goals, and the goal `none`. One object serves N environments.

    The task calls `add_to_model` before the model is compiled, `attach` when the simulation exists,
    and `reset` at the start of episodes. In every control step the task calls `before_step`, runs
    the physics, and calls `after_step`, `observe` and `reward`. docs/own_task.md shows how to write
    a goal.

    Args:
        env: the section `task.env`, where null selects the default of a key.

    Attributes:
        settings: the goal's keys, an object of `settings_class`.
        num_task_obs: dimension of the goal's observation, which is 0 if `enableTaskObs` is False.
        simulation: the backend, set by `attach`.
        dt_s: duration of a control step (s).
        prev_root_pos_w: (N, 3) m, positions of the characters before the last control step.
        key_bodies: names of the bodies whose positions in clips are known (`ClipsAhead`).

    Raises:
        ConfigError: a value is invalid.
    """

    not_stored = ("simulation",)
    num_obs: ClassVar[int] = 0
    """Dimension of the goal's observation."""
    obs_name: ClassVar[str] = "goal"
    """Name of the goal's observation. `command` means (m/s forward, m/s left, rad/s left)."""
    key_help: ClassVar[str] = ""
    """Help text about the keys of `on_key`, empty if the goal has no keys."""
    look_ahead_s: ClassVar[tuple[float, ...]] = ()
    """`ClipsAhead` has what the clips do at these times (s) from a moment, the past is negative."""
    forgives_failures: bool = False
    """Whether `failures` end episodes of a training like the time limit, and cost nothing."""
    num_commands: int = 0
    """Number C of values in a command of the agent (`CommandedSkillEnv`)."""
    settings_class: ClassVar[type[GoalSettings]] = GoalSettings

    def __init__(self, env: Mapping[str, Any]) -> None:
        given = {key: env[key] for key in self.keys() if env.get(key) is not None}
        self.settings: Any = read_section(self.settings_class, given, "task.env")
        self.num_task_obs = self.num_obs if self.settings.enable_task_obs else 0
        self.key_bodies: tuple[str, ...] = ()

    @classmethod
    def keys(cls) -> frozenset[str]:
        """Return the keys of `task.env` that the goal reads."""
        return keys_of(cls.settings_class)

    def add_to_model(self, spec: mujoco.MjSpec) -> None:
        """Add the goal's objects to the model of the character."""

    def attach(self, simulation: SimulationBackend, dt_s: float) -> None:
        """Allocate buffers for N environments with control steps of `dt_s` seconds.

        Raises:
            ConfigError: the character lacks a body that the goal names.
        """
        self.simulation = simulation
        self.dt_s = dt_s
        self.prev_root_pos_w = torch.zeros(simulation.num_envs, 3, device=simulation.device)

    def reset(self, env_ids: Tensor) -> None:
        """Draw goals for new episodes of `env_ids` (n,), whose characters are already reset."""

    def start_in_clips(self, env_ids: Tensor, ahead: ClipsAhead) -> None:
        """Replace the goals of a random share `clip_share` of episodes (n,), which start in clips.

        The clips reach the new goals (`follow_clips`). A policy that gets only random goals may
        never try what earns more than its habits.
        """
        if self.settings.clip_share == 0:
            return
        follows = torch.rand(len(env_ids), device=env_ids.device) < self.settings.clip_share
        self.follow_clips(env_ids[follows], ahead.rows(follows))

    def follow_clips(self, env_ids: Tensor, ahead: ClipsAhead) -> None:
        """Give episodes `env_ids` (n,), which start in clips, goals that the clips reach."""

    def observe_clips(self, ahead: ClipsAhead) -> Tensor | None:
        """Return the observations (n, num_obs) of goals that n clips reach, or None.

        With None a warm start has random goals, and the policy learns to follow the clips whatever
        the goal is.
        """
        return None

    def commands_of_clips(self, ahead: ClipsAhead) -> Tensor:
        """Return the commands (n, C) that n clips carry out."""
        raise NotImplementedError(f"{type(self).__name__} takes no commands")

    def command(self, env_ids: Tensor, commands: Tensor) -> None:
        """Give commands (n, C) of the agent to characters `env_ids` (n,)."""
        raise NotImplementedError(f"{type(self).__name__} takes no commands")

    def before_step(self, progress: Tensor) -> None:
        """Prepare a control step of episodes that have lasted `progress` (N,) control steps."""
        self.prev_root_pos_w.copy_(self.simulation.root_states[:, :3])

    def after_step(self) -> None:
        """Update the goal's own state after the physics of a control step."""

    def observe(self, env_ids: Tensor | None) -> Tensor:
        """Return the observations (n, num_obs) of `env_ids` (n,). None selects all environments."""
        raise NotImplementedError(f"{type(self).__name__} has nothing to observe")

    def reward(self) -> Tensor | Terms:
        """Return the rewards (N,) of the last step, or their named terms; 1 in the base class."""
        return torch.ones(self.simulation.num_envs, device=self.simulation.device)

    def errors(self) -> dict[str, Tensor]:
        """Return errors (N,) of the last step by names with units. Evaluations report means."""
        return {}

    def successes(self) -> dict[str, Tensor]:
        """Return by name how far the running episodes (N,) succeeded (0 to 1)."""
        return {}

    def on_key(self, key: str) -> None:
        """React to a key press in a viewer (see `VecTask.on_key`)."""

    def failures(self, contact_body_ids: Tensor) -> Tensor | None:
        """Return where a goal (N,) cannot be reached any more, or None if goals always can.

        `contact_body_ids` (C,) are the bodies that may touch something.
        """

    def markers(self, env_id: int) -> tuple[Marker, ...]:
        """Return the markers that picture the goal of one environment."""
        return ()

    def ground_arrow(self, env_id: int, direction: Tensor, colour: Colour) -> Arrow:
        """Return an arrow at the feet of the character, along the unit vector `direction` (2,)."""
        x, y = self.simulation.root_states[env_id, :2].tolist()
        dx, dy = direction.tolist()
        return arrow_on_ground((x, y), (dx, dy), colour)

    def rows(self, values: Tensor, env_ids: Tensor | None) -> Tensor:
        """Return the rows (n, ...) of values (N, ...) for `env_ids` (n,). None selects all rows."""
        return values if env_ids is None else values.index_select(0, env_ids)

    def root_states(self, env_ids: Tensor | None = None) -> Tensor:
        """Return root states (n, 13): world position, rotation xyzw, both velocities."""
        return self.rows(self.simulation.root_states, env_ids)


class TimedGoal(Goal):
    """A goal that changes after `change_steps_min` to `change_steps_max` - 1 control steps."""

    change_steps_keys: ClassVar[tuple[str, str]] = ("tarChangeStepsMin", "tarChangeStepsMax")
    """Names of `change_steps_min` and `change_steps_max` in `task.env`."""

    def attach(self, simulation: SimulationBackend, dt_s: float) -> None:
        """Run the base method, and set the timers to 0, so that the first step draws goals."""
        low_key, high_key = self.change_steps_keys
        low, high = self.settings.change_steps_min, self.settings.change_steps_max
        check_range(low_key, low, high_key, high, equal=False)
        super().attach(simulation, dt_s)
        self.change_steps = torch.zeros(
            simulation.num_envs, dtype=torch.int64, device=simulation.device
        )

    def reset(self, env_ids: Tensor) -> None:
        """Draw goals and the times of their changes."""
        self._redraw(env_ids, torch.zeros_like(env_ids))

    def before_step(self, progress: Tensor) -> None:
        """Run the base method, and replace the goals that have expired."""
        super().before_step(progress)
        over = (progress >= self.change_steps).nonzero().flatten()
        if len(over) > 0:
            self._redraw(over, progress.index_select(0, over))

    def _redraw(self, env_ids: Tensor, progress: Tensor) -> None:
        cfg = self.settings
        steps = torch.randint(
            cfg.change_steps_min, cfg.change_steps_max, (len(env_ids),), device=env_ids.device
        )
        self.change_steps.index_copy_(0, env_ids, progress + steps)
        self.draw(env_ids)

    def draw(self, env_ids: Tensor) -> None:
        """Draw goals for `env_ids` (n,)."""
        raise NotImplementedError


class PointGoal(TimedGoal):
    """A timed goal that is reached when the character comes near a point.

    Its success is the share of an episode's points that were reached. The last point counts, too,
    although its time is cut short.
    """

    reached_m: ClassVar[float]
    """A point is reached within this distance."""

    def attach(self, simulation: SimulationBackend, dt_s: float) -> None:
        """Run the base method, and allocate the counts of points and of reached points."""
        super().attach(simulation, dt_s)
        n, device = simulation.num_envs, simulation.device
        self._is_reached = torch.zeros(n, dtype=torch.bool, device=device)
        self._num_reached = torch.zeros(n, device=device)
        self._num_points = torch.zeros(n, device=device)

    def reset(self, env_ids: Tensor) -> None:
        """Clear the counts of the previous episode, and run the base method."""
        self._num_reached.index_fill_(0, env_ids, 0.0)
        self._num_points.index_fill_(0, env_ids, 0.0)
        super().reset(env_ids)

    def _redraw(self, env_ids: Tensor, progress: Tensor) -> None:
        super()._redraw(env_ids, progress)
        self._is_reached.index_fill_(0, env_ids, False)
        self._num_points[env_ids] += 1.0

    def after_step(self) -> None:
        """Count the points that are reached in this step for the first time."""
        super().after_step()
        is_near = self.distances() < self.reached_m
        self._num_reached += is_near & ~self._is_reached
        self._is_reached |= is_near

    def distances(self) -> Tensor:
        """Return the distances (N,) m from the points."""
        raise NotImplementedError

    def successes(self) -> dict[str, Tensor]:
        """Return the shares (N,) of points that were reached."""
        return {"reached": self._num_reached / self._num_points.clamp(min=1.0)}


def check_range(low_key: str, low: float, high_key: str, high: float, *, equal: bool) -> None:
    """Raise ConfigError if low > high, or if low = high and `equal` is False."""
    if low > high or (low == high and not equal):
        expected = "at most" if equal else "less than"
        raise ConfigError(
            f"task.env.{low_key}={low:g} and task.env.{high_key}={high:g}:"
            f" expected {low_key} to be {expected} {high_key}"
        )
