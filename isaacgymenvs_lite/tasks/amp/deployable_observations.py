"""What a real robot measures, as the observation of its policy; pure functions of named tensors.

An inertial unit in the base gives its turning rate and, filtered, the direction of gravity; the
encoders give positions and velocities of the joints; the controller stores what it sent last. Not
measured are the position and the linear velocity of the base and the places of bodies.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.base.velocity_tracking import compute_base_motion
from isaacgymenvs_lite.utils.rotations import normalize

_GRAVITY = slice(3, 6)  # of a frame


def frame_groups(num_dofs: int) -> dict[str, int]:
    """Return the parts of one frame in their order: name -> how many numbers; 6 + 3 D in all.

    Args:
        num_dofs: D.
    """
    base = {"root_ang_vel_b": 3, "gravity_b": 3}
    return base | dict.fromkeys(("dof_pos_offset", "dof_vel", "last_action"), num_dofs)


def history_groups(num_dofs: int, num_frames: int) -> dict[str, int]:
    """Return the parts of several frames, the newest first.

    The names of older frames end in `_1`, `_2` and so on, by how many control steps ago they were.

    Args:
        num_dofs: D.
        num_frames: H, at least 1.
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
    """Return what robots measure at one time.

    Args:
        root_states: (N, 13) world position, rotation xyzw, linear and angular velocity in world
            axes (m, m/s, rad/s). Position and linear velocity are not used.
        dof_pos: (N, D) rad; of a ball joint the three numbers of its exponential map.
        dof_vel: (N, D) rad/s.
        start_dof_pos: (D,) rad of the start pose. The offset of a ball joint is the difference of
            the exponential maps, number by number: zero in the start pose, and a rotation only
            where that is zero itself.
        last_action: (N, D) clamped actions of the last control step.

    Returns:
        (N, 6 + 3 D): angular velocity of the base in its frame (rad/s), unit vector of gravity in
        that frame, joint positions minus the start pose, joint velocities, last action; see
        `frame_groups`.
    """
    motion = compute_base_motion(root_states)
    base = torch.cat((motion.ang_vel, motion.gravity)).t()
    return torch.cat((base, dof_pos - start_dof_pos, dof_vel, last_action), dim=-1)


def noise_widths(noise: Mapping[str, float], num_dofs: int) -> Tensor:
    """Return (6 + 3 D,) half the widths of the uniform noise on each number of a frame.

    Args:
        noise: half width by the part's name; parts that are not named have none.
        num_dofs: D.
    """
    sizes = frame_groups(num_dofs)
    return torch.cat([torch.full((size,), noise.get(name, 0.0)) for name, size in sizes.items()])


def add_noise(frame: Tensor, widths: Tensor) -> Tensor:
    """Return frames (N, F) with uniform noise of half widths (F,); gravity is again a unit vector.

    A filter returns a direction, whatever its error.
    """
    noisy = torch.rand_like(frame).mul_(2.0).sub_(1.0).mul_(widths).add_(frame)
    noisy[:, _GRAVITY] = normalize(noisy[:, _GRAVITY])
    return noisy
