"""Degrees of freedom of poses, and back."""

from __future__ import annotations

import numpy as np
import pytest

from isaacgymenvs_lite.motion.qpos import dofs_from_rotations, rotations_from_dofs
from isaacgymenvs_lite.motion.skeleton import Skeleton


@pytest.mark.parametrize("num_dofs", [28, 31])
def test_round_trip(num_dofs: int, humanoid: Skeleton, armed: Skeleton) -> None:
    skeleton = {28: humanoid, 31: armed}[num_dofs]
    random = np.random.default_rng(0)
    # Rotation vectors shorter than pi are unique.
    dofs = random.uniform(-1.5, 1.5, (20, num_dofs))
    root = np.tile([0.0, 0.0, 0.6, 0.8], (20, 1))
    local = rotations_from_dofs(skeleton, root, dofs)
    np.testing.assert_array_equal(local[:, 0], root)
    np.testing.assert_allclose(dofs_from_rotations(skeleton, local), dofs, atol=1e-12)


def test_names_and_limits_are_those_of_the_published_joints(humanoid: Skeleton) -> None:
    degrees = dict(zip(humanoid.dof_names, np.degrees(humanoid.dof_limits).tolist(), strict=True))
    assert degrees["abdomen_y"] == pytest.approx([-60.0, 90.0])
    assert degrees["left_shoulder_x"] == pytest.approx([-45.0, 180.0])
    assert degrees["right_elbow"] == pytest.approx([-160.0, 0.0])
    assert degrees["left_knee"] == pytest.approx([0.0, 160.0])
