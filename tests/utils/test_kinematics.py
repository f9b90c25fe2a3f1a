"""Forward kinematics against MuJoCo's own."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from isaacgymenvs_lite.utils.kinematics import Floats, Kinematics


def _random_qpos(model: mujoco.MjModel, n: int) -> np.ndarray:
    """Random positions (n, nq); the quaternions among them are not of unit length."""
    return np.random.default_rng(0).normal(size=(n, model.nq))


def _poses(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[Floats, Floats]:
    """Our positions (n, B, 3) and rotations (n, B, 4) xyzw, of all bodies."""
    kinematics = Kinematics(model)
    shape = (model.nbody - 1, len(qpos))
    positions = np.full((3, *shape), np.nan, dtype=np.float32)
    rotations = np.full((4, *shape), np.nan, dtype=np.float32)
    columns = np.ascontiguousarray(qpos.T, dtype=np.float32)
    kinematics.poses(columns, positions, rotations)
    return positions.T, rotations.T


def _assert_poses_are_mujoco_s(model: mujoco.MjModel, qpos: np.ndarray) -> None:
    positions, rotations = _poses(model, qpos)
    data = mujoco.MjData(model)
    for state, values in enumerate(qpos):
        data.qpos[:] = values
        mujoco.mj_kinematics(model, data)
        # float32 through a handful of products of numbers of order 1
        np.testing.assert_allclose(positions[state], data.xpos[1:], rtol=0.0, atol=5e-6)
        turned_by = Rotation.from_matrix(data.xmat[1:].reshape(-1, 3, 3)).inv() * (
            Rotation.from_quat(rotations[state])
        )
        np.testing.assert_allclose(turned_by.magnitude(), 0.0, atol=5e-6)


def test_a_model_with_all_types_of_joints(made_up_model) -> None:
    _assert_poses_are_mujoco_s(made_up_model, _random_qpos(made_up_model, 50))


def test_the_humanoid(humanoid_model) -> None:
    _assert_poses_are_mujoco_s(humanoid_model, _random_qpos(humanoid_model, 50))


def test_rotations_are_unit_and_follow_the_root_s_sign(humanoid_model) -> None:
    qpos = _random_qpos(humanoid_model, 20)
    _, rotations = _poses(humanoid_model, qpos)
    np.testing.assert_allclose(np.linalg.norm(rotations, axis=-1), 1.0, atol=2e-6)
    w = qpos[:, 3] / np.linalg.norm(qpos[:, 3:7], axis=-1)
    np.testing.assert_allclose(rotations[:, 0, 3], w, atol=2e-6)


def test_two_bars_by_hand() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body pos="0 0 1"><joint axis="0 0 1"/><geom size="0.1"/>'
        '<body pos="2 0 0"><joint axis="0 0 1"/><geom size="0.1"/>'
        '<body pos="3 0 0"><geom size="0.1"/></body></body></body></worldbody></mujoco>'
    )
    # A quarter turn at each joint: along y, then back along x.
    positions, rotations = _poses(model, np.full((1, 2), np.pi / 2.0))
    expected = [[0.0, 0.0, 1.0], [0.0, 2.0, 1.0], [-3.0, 2.0, 1.0]]
    np.testing.assert_allclose(positions[0], expected, atol=1e-6)
    half_turn = [0.0, 0.0, 1.0, 0.0]
    np.testing.assert_allclose(rotations[0, 1:], [half_turn, half_turn], atol=1e-6)


def test_a_state_that_is_no_number_stays_alone(humanoid_model) -> None:
    qpos = _random_qpos(humanoid_model, 3)
    qpos[1, 7] = np.nan
    positions, rotations = _poses(humanoid_model, qpos)
    assert np.isfinite(positions[[0, 2]]).all()
    assert np.isfinite(rotations[[0, 2]]).all()
    assert np.isnan(positions[1, 2]).all()
