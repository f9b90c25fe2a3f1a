"""Observations and delays of a real robot, as pure functions and small buffers.

An inertial unit measures the angular velocity of the base and the direction of gravity. Encoders
measure joint positions and velocities, and the controller knows its last action. A robot cannot
measure body positions or the position and linear velocity of the base. One measurement of all
measurable quantities is called a frame.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.base.velocity_tracking import compute_base_motion
from isaacgymenvs_lite.utils.rotations import normalize
from isaacgymenvs_lite.utils.state import Stateful

_GRAVITY = slice(3, 6)  # columns of a frame


def frame_groups(num_dofs: int) -> dict[str, int]:
    """Return names and sizes of the parts of a frame, which has 6 + 3 D values."""
    base = {"root_ang_vel_b": 3, "gravity_b": 3}
    return base | dict.fromkeys(("dof_pos_offset", "dof_vel", "last_action"), num_dofs)


def history_groups(num_dofs: int, num_frames: int) -> dict[str, int]:
    """Return names and sizes of the parts of several frames, newest frame first.

    The part names of older frames end in the frame's age in control steps: `_1`, `_2` and so on.
    """
    frame = frame_groups(num_dofs)
    return {
        name if age == 0 else f"{name}_{age}": size
        for age in range(num_frames)
        for name, size in frame.items()
    }


def compute_frame(
    root_states: Tensor,
    dof_pos: Tensor,
    dof_vel: Tensor,
    start_dof_pos: Tensor,
    last_action: Tensor,
) -> Tensor:
    """Return the frames (N, 6 + 3 D) of robots (see `frame_groups`).

    A frame consists of the angular velocity of the base (rad/s) and the direction of gravity in
    base axes, joint positions minus the start pose (rad), joint velocities (rad/s), and the clamped
    last action. The position of a ball joint is its exponential map (3 components) minus the
    exponential map of the start pose.
    """
    motion = compute_base_motion(root_states)
    base = torch.cat((motion.ang_vel, motion.gravity)).t()
    return torch.cat((base, dof_pos - start_dof_pos, dof_vel, last_action), dim=-1)


def noise_widths(noise: Mapping[str, float], num_dofs: int) -> Tensor:
    """Return half the widths (6 + 3 D,) of the uniform noise on a frame.

    `noise` maps names of parts to half widths. Missing parts have no noise.
    """
    sizes = frame_groups(num_dofs)
    return torch.cat([torch.full((size,), noise.get(name, 0.0)) for name, size in sizes.items()])


def add_noise(frame: Tensor, widths: Tensor) -> Tensor:
    """Add uniform noise of half widths (F,) to frames (N, F), and normalise the gravity vector."""
    noisy = torch.rand_like(frame).mul_(2.0).sub_(1.0).mul_(widths).add_(frame)
    noisy[:, _GRAVITY] = normalize(noisy[:, _GRAVITY])
    return noisy


class ActionDelay(Stateful):
    """Delays actions by `least` to `most` control steps. Each episode draws its delay."""

    def __init__(
        self, least: int, most: int, num_envs: int, num_actions: int, device: torch.device
    ) -> None:
        self._limits = (least, most)
        self.steps = torch.full((num_envs,), least, dtype=torch.int64, device=device)
        # (N, most + 1, A) actions, newest first
        self._actions = torch.zeros(num_envs, most + 1, num_actions, device=device)
        self._rows = torch.arange(num_envs, device=device)

    def reset(self, env_ids: Tensor) -> None:
        """Draw the delays of new episodes (n,), and set their previous actions to zero."""
        least, most = self._limits
        drawn = torch.randint(least, most + 1, (len(env_ids),), device=env_ids.device)
        self.steps.index_copy_(0, env_ids, drawn)
        self._actions.index_fill_(0, env_ids, 0.0)

    def __call__(self, actions: Tensor) -> Tensor:
        """Store the actions (N, A) of a control step, and return the delayed actions."""
        push_newest(self._actions, actions)
        return self._actions[self._rows, self.steps]


def push_newest(history: Tensor, newest: Tensor) -> None:
    """Insert values (N, ...) into a history (N, H, ...), in place, and drop the oldest values."""
    for age in range(history.shape[1] - 1, 0, -1):
        history[:, age] = history[:, age - 1]
    history[:, 0] = newest
