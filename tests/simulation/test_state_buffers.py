"""Component-major state: the buffers and their way from and to MuJoCo's coordinates."""

from __future__ import annotations

import numpy as np
import torch

from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.simulation.state_buffers import (
    StateBuffers,
    StateConverter,
    as_tensor,
)


def test_rows_and_back(humanoid_model, random_state) -> None:
    layout = ModelLayout.from_model(humanoid_model)
    converter = StateConverter(humanoid_model, layout)
    root, dof_pos, dof_vel = random_state(5, seed=0)
    qpos, qvel = converter.rows(root, dof_pos, dof_vel)
    assert (qpos.shape, qvel.shape) == ((5, 43), (5, 34))
    assert (qpos.dtype, qvel.dtype) == (np.float64, np.float64)
    buffers = StateBuffers(layout, 5)
    converter.fill(buffers, qpos, qvel)
    for buffer, expected in (
        (buffers.root_states, root),
        (buffers.dof_pos, dof_pos),
        (buffers.dof_vel, dof_vel),
    ):
        torch.testing.assert_close(as_tensor(buffer), expected, rtol=0.0, atol=2e-6)
    assert not buffers.bodies_are_current
    converter.fill_bodies(buffers)
    np.testing.assert_allclose(buffers.body_pos[:, 0], root[:, :3].T, atol=1e-6)


def test_the_length_of_the_root_s_quaternion_does_not_scale_its_velocity(
    humanoid_model, random_state
) -> None:
    # Clips hold rotations whose length is off by some 1e-6.
    layout = ModelLayout.from_model(humanoid_model)
    converter = StateConverter(humanoid_model, layout)
    root, dof_pos, dof_vel = random_state(3, seed=0)
    root[:, 3:7] *= torch.tensor([[1.01], [0.9], [0.0]])
    buffers = StateBuffers(layout, 3)
    converter.fill(buffers, *converter.rows(root, dof_pos, dof_vel))
    torch.testing.assert_close(
        as_tensor(buffers.root_states)[:, 10:], root[:, 10:], rtol=0.0, atol=2e-6
    )
