"""Wrenches on bodies: the force of one contact, by its lever."""

from __future__ import annotations

import torch
from scipy.spatial.transform import Rotation

from isaacgymenvs_lite.tasks.base.wrenches import body_wrenches, torques_about

_NUM_ENVS = 3


def _contact() -> tuple[torch.Tensor, ...]:
    """Return rotation xyzw, position, contact point and force on a body, (N, ...) each."""
    generator = torch.Generator().manual_seed(0)
    pos, point, force = torch.randn(3, _NUM_ENVS, 3, generator=generator, dtype=torch.float64)
    rot = torch.randn(_NUM_ENVS, 4, generator=generator, dtype=torch.float64)
    return rot / rot.norm(dim=-1, keepdim=True), pos, point, force


def _measured(point: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
    """Return (9, 1, N) what a sensor says of a contact at `point`, about another point."""
    about = point + torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    torque = torch.linalg.cross(point - about, -force)
    return torch.cat((-force, torque, about), dim=-1).t()[:, None]


def _axes(rot: torch.Tensor) -> torch.Tensor:
    """Return (3, 3, 1, N): a body's x, y and z axis are the columns of its rotation's matrix."""
    matrices = torch.from_numpy(Rotation.from_quat(rot.numpy()).as_matrix())
    return matrices.permute(2, 1, 0)[:, :, None]


def _to_body(rot: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(Rotation.from_quat(rot.numpy()).inv().apply(vectors.numpy()))


def test_a_contact_force_turns_by_its_lever_in_the_frame_of_the_body() -> None:
    rot, pos, point, force = _contact()
    wrench = body_wrenches(_measured(point, force), pos.t()[:, None], _axes(rot))[:, 0].t()
    torque = torch.linalg.cross(point - pos, force)
    torch.testing.assert_close(wrench[:, :3], _to_body(rot, force))
    torch.testing.assert_close(wrench[:, 3:], _to_body(rot, torque))


def test_torques_about_other_points_of_the_body() -> None:
    rot, pos, point, force = _contact()
    wrench = body_wrenches(_measured(point, force), pos.t()[:, None], _axes(rot))[:, 0]
    sensors = torch.tensor([[0.0, 0.0, 0.0], [0.4, 0.0, 0.1]], dtype=torch.float64)
    torques = torques_about(wrench, sensors)
    lever, pull = _to_body(rot, point - pos), _to_body(rot, force)
    for sensor, found in zip(sensors, torques.unbind(1), strict=True):
        torch.testing.assert_close(found.t(), torch.linalg.cross(lever - sensor, pull))
