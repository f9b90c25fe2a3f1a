"""Strike: knock a standing box over, as in ASE's HumanoidStrike."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.simulation.backend import SimulationBackend
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.goals.boxes import add_box
from isaacgymenvs_lite.tasks.goals.goal import ClipsAhead, Goal, GoalSettings
from isaacgymenvs_lite.tasks.goals.planar import (
    in_heading_frame,
    planar_velocity,
    speed_reward,
)
from isaacgymenvs_lite.utils.rotations import (
    calc_heading_quat_inv,
    normalize,
    quat_mul,
    quat_to_tan_norm,
)

TARGET_NAME = "target"
_TARGET_SIZE_M = (0.4, 0.4, 1.8)
_TARGET_DENSITY = 30.0  # kg/m^3: 8.64 kg
_TARGET_HEIGHT_M = 0.5 * _TARGET_SIZE_M[2]
_DIST_MIN_M, _DIST_MAX_M, _NEAR_DIST_M, _NEAR_PROB = 0.5, 10.0, 1.5, 0.5
# The centre of a box that suits a clip is so far before the farthest point of the striking body
# that the push tips the box, but far enough from the character that no episode starts with a touch.
# If a clip travels, the box may be farther away by up to so many times the way.
_BEFORE_M, _CLEAR_M = 0.1, 0.6
_FARTHER = 2.0
_STRIKE_BODIES = ("sword", "right_hand", "right_lower_arm")

_SPEED_SCALE, _SPEED_M_S = 4.0, 1.0
_TILT_WEIGHT, _SPEED_WEIGHT = 0.6, 0.4
_FALLEN_COS = 0.2  # cosine of the tilt of a fallen box
_CONTACT_THRESHOLD_N = 1.0


def compute_strike_observations(root_states: Tensor, tar_states: Tensor) -> Tensor:
    """Return the states of boxes in the heading frames of roots; both arguments are (n, 13).

    The observation (n, 15) consists of position (with the height above the ground), rotation
    (tangent, normal), linear velocity and angular velocity.
    """
    root_rot = root_states[:, 3:7]
    plane = tar_states[:, :2] - root_states[:, :2]
    position = torch.cat((plane, tar_states[:, 2:3]), dim=-1)
    rotation = quat_mul(calc_heading_quat_inv(root_rot), tar_states[:, 3:7])
    return torch.cat(
        (
            in_heading_frame(root_rot, position),
            quat_to_tan_norm(rotation),
            in_heading_frame(root_rot, tar_states[:, 7:10]),
            in_heading_frame(root_rot, tar_states[:, 10:13]),
        ),
        dim=-1,
    )


def upright_cos(rot: Tensor) -> Tensor:
    """Return the cosines (n,) of the tilts of rotations (n, 4), xyzw."""
    return quat_to_tan_norm(rot)[:, 5]  # height of the z axis


def compute_strike_reward(
    tar_pos: Tensor, tar_rot: Tensor, root_pos: Tensor, prev_root_pos: Tensor, dt: float
) -> Tensor:
    """Return the reward (n,) in [0, 1] of tilting and approaching the box, 1 for a fallen box.

    Positions (n, 3) are in m, `tar_rot` (n, 4) is xyzw, and `dt` (s) is the duration of the step.
    """
    upright = upright_cos(tar_rot)
    direction = normalize(tar_pos[:, :2] - root_pos[:, :2], eps=1e-12)
    speed = (direction * planar_velocity(root_pos, prev_root_pos, dt)).sum(-1)
    tilt = (1.0 - upright).clamp(min=0.0)
    reward = _TILT_WEIGHT * tilt + _SPEED_WEIGHT * speed_reward(speed, _SPEED_M_S, _SPEED_SCALE)
    return reward.masked_fill(upright < _FALLEN_COS, 1.0)


def compute_strike_failures(
    tar_contact_forces: Tensor, contact_forces: Tensor, allowed_body_ids: Tensor
) -> Tensor:
    """Return where (n,) the box is touched while a forbidden body touches something.

    The forces (n, 3) on the box and (n, B, 3) on the bodies are in newton.
    """
    touched = (tar_contact_forces[:, :2].abs() > _CONTACT_THRESHOLD_N).any(dim=-1)
    forces = contact_forces.abs().amax(dim=-1).index_fill(1, allowed_body_ids, 0.0)
    return touched & (forces > _CONTACT_THRESHOLD_N).any(dim=-1)


@dataclass(frozen=True)
class StrikeSettings(GoalSettings):
    """Keys of `task.env` for the goal `strike`."""

    strike_body_names: tuple[str, ...] = setting((), key="strikeBodyNames")
    forgive_touch: float = setting(0.0, key="forgiveTouch", minimum=0, maximum=1)


class Strike(Goal):
    """The goal `strike`.

    Attributes:
        fell_share: share of the boxes that fell, over about the last 2 N episodes.
    """

    num_obs = 15
    look_ahead_s = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
    settings_class = StrikeSettings
    settings: StrikeSettings

    def add_to_model(self, spec: mujoco.MjSpec) -> None:
        """Add the box."""
        add_box(spec, TARGET_NAME, _TARGET_SIZE_M, _TARGET_DENSITY, (2.0, 0.0, _TARGET_HEIGHT_M))

    def attach(self, simulation: SimulationBackend, dt_s: float) -> None:
        """Run the base method and look up the box and the striking bodies."""
        super().attach(simulation, dt_s)
        self._fell = torch.zeros(simulation.num_envs, device=simulation.device)
        self.fell_share = 0.0
        self.forgives_failures = self.settings.forgive_touch > 0.0
        names = simulation.body_names
        wanted = self.settings.strike_body_names
        for name in wanted:
            if name not in names:
                raise ConfigError(unknown("body in task.env.strikeBodyNames:", name, names))
        self._bodies = [name for name in wanted or _STRIKE_BODIES if name in names]
        ids = [names.index(name) for name in self._bodies]
        self.strike_body_ids = torch.tensor(ids, dtype=torch.int64, device=simulation.device)
        self._target = simulation.object_names.index(TARGET_NAME)

    def reset(self, env_ids: Tensor) -> None:
        """Place the boxes upright at random positions around the characters."""
        n, device = len(env_ids), env_ids.device
        self._count_fallen(env_ids)
        near = torch.rand(n, device=device) < _NEAR_PROB
        furthest = torch.full((n,), _DIST_MAX_M, device=device).masked_fill(near, _NEAR_DIST_M)
        distance = _DIST_MIN_M + torch.rand(n, device=device) * (furthest - _DIST_MIN_M)
        bearing = uniform(env_ids, 0.0, math.tau)
        offset = distance.unsqueeze(-1) * torch.stack((bearing.cos(), bearing.sin()), dim=-1)
        self._place(env_ids, offset)

    def _count_fallen(self, env_ids: Tensor) -> None:
        """Count the fallen boxes of episodes (n,) that ended."""
        surplus = float((self._fell[env_ids] - self.fell_share).sum())  # 0 if no episode ended
        self.fell_share += surplus / (2 * self.simulation.num_envs)
        self._fell.index_fill_(0, env_ids, 0.0)
        if self.fell_share >= self.settings.forgive_touch:
            self.forgives_failures = False

    def observe_clips(self, ahead: ClipsAhead) -> Tensor | None:
        """Return observations (n, 15) of boxes where the striking bodies go in n clips."""
        root, offset = ahead.root_states[:, 0], self._offsets_of_clips(ahead)
        if offset is None:
            return None
        return compute_strike_observations(root, self._standing(root[:, :2] + offset))

    def follow_clips(self, env_ids: Tensor, ahead: ClipsAhead) -> None:
        """Place the boxes where the striking bodies go in the clips."""
        offset = self._offsets_of_clips(ahead)
        if offset is not None:
            self._place(env_ids, offset)

    def _offsets_of_clips(self, ahead: ClipsAhead) -> Tensor | None:
        """Return offsets (n, 2) m of boxes from roots. None: no key body may strike."""
        name = next((body for body in self._bodies if body in ahead.body_pos_w), None)
        if name is None:
            return None
        offsets = ahead.body_pos_w[name][:, :, :2] - ahead.root_states[:, :1, :2]
        distances, farthest = torch.linalg.vector_norm(offsets, dim=-1).max(dim=1)
        offset = offsets[torch.arange(len(offsets), device=offsets.device), farthest]
        direction = normalize(offset)
        way = ahead.root_states[:, -1, :2] - ahead.root_states[:, 0, :2]
        farther = _FARTHER * torch.rand_like(distances) * (way * direction).sum(-1).clamp(min=0.0)
        away = (distances - _BEFORE_M).clamp(min=_CLEAR_M) + farther
        return away.unsqueeze(-1) * direction

    def _place(self, env_ids: Tensor, offset: Tensor) -> None:
        """Place the boxes `offset` (n, 2) m from the characters."""
        states = self._standing(self.root_states(env_ids)[:, :2] + offset)
        object_ids = torch.tensor([self._target], device=env_ids.device)
        self.simulation.write_object_states(env_ids, object_ids, states.unsqueeze(1))

    def _standing(self, position_w: Tensor) -> Tensor:
        """Return states (n, 13) of boxes that stand at positions (n, 2) m, with random headings."""
        half_turn = math.pi * torch.rand(len(position_w), device=position_w.device)
        states = torch.zeros(len(position_w), 13, device=position_w.device)
        states[:, :2], states[:, 2] = position_w, _TARGET_HEIGHT_M
        states[:, 5], states[:, 6] = half_turn.sin(), half_turn.cos()
        return states

    def _target_states(self, env_ids: Tensor | None = None) -> Tensor:
        return self.rows(self.simulation.object_states[:, self._target], env_ids)

    def after_step(self) -> None:
        """Store which boxes fell, because a reset puts them back on their feet."""
        super().after_step()
        self._fell = self.successes()["box_fell"]

    def observe(self, env_ids: Tensor | None) -> Tensor:
        """See `compute_strike_observations`."""
        return compute_strike_observations(self.root_states(env_ids), self._target_states(env_ids))

    def reward(self) -> Tensor:
        """See `compute_strike_reward`."""
        target, root = self._target_states(), self.root_states()
        return compute_strike_reward(
            target[:, :3], target[:, 3:7], root[:, :3], self.prev_root_pos_w, self.dt_s
        )

    def successes(self) -> dict[str, Tensor]:
        """Return which boxes (N,) fell."""
        return {"box_fell": (upright_cos(self._target_states()[:, 3:7]) < _FALLEN_COS).float()}

    def failures(self, contact_body_ids: Tensor) -> Tensor:
        """See `compute_strike_failures`."""
        return compute_strike_failures(
            self.simulation.object_contact_forces[:, self._target],
            self.simulation.contact_forces,
            torch.cat((contact_body_ids, self.strike_body_ids)),
        )
