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

NAMES = ("root_states", "dof_vel", "dof_pos", "body_pos", "body_rot", "contact_forces")


def test_buffers_do_not_overlap(humanoid_model) -> None:
    buffers = StateBuffers(ModelLayout.from_model(humanoid_model), 3)
    shapes = [getattr(buffers, name).shape for name in NAMES]
    assert shapes == [(13, 3), (28, 3), (28, 3), (3, 15, 3), (4, 15, 3), (3, 15, 3)]
    for value, name in enumerate(NAMES):
        getattr(buffers, name)[:] = value
    for value, name in enumerate(NAMES):
        assert (getattr(buffers, name) == value).all(), name
    # the velocities of the root (of value 0) and those of the joints (of value 1)
    assert buffers.velocities[:, 0].tolist() == [0.0] * 6 + [1.0] * 28


def test_replace_leaves_the_others(humanoid_model) -> None:
    layout = ModelLayout.from_model(humanoid_model)
    buffers, others = StateBuffers(layout, 4), StateBuffers(layout, 2)
    others.body_pos[:] = [5.0, 7.0]
    others.root_states[:] = [6.0, 8.0]
    buffers.replace(np.array([3, 1]), others)
    assert buffers.body_pos[2, 14].tolist() == [0.0, 7.0, 0.0, 5.0]
    assert buffers.root_states[12].tolist() == [0.0, 8.0, 0.0, 6.0]
    assert (buffers.contact_forces == 0.0).all()


def test_tensors_share_the_memory_of_the_buffers(humanoid_model) -> None:
    buffers = StateBuffers(ModelLayout.from_model(humanoid_model), 4)
    tensor = as_tensor(buffers.body_pos)
    assert tuple(tensor.shape) == (4, 15, 3)
    buffers.body_pos[2, 7, 1] = 9.0
    assert float(tensor[1, 7, 2]) == 9.0


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
