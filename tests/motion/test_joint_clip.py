from __future__ import annotations

import numpy as np
import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import JointClip


def clip_of(names, num_dofs=None):
    width = num_dofs or len(names)
    dofs = np.tile(np.arange(1.0, width + 1.0), (2, 1))
    return JointClip("a", 30.0, np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)), dofs, names)


def test_joints_are_ordered_by_name_and_endings_do_not_count():
    fitted = clip_of(("hip_joint", "knee_joint")).fitted_to(("knee", "hip"))
    assert fitted.dof_pos[0].tolist() == [2.0, 1.0]
    assert fitted.joint_names == ("knee", "hip")


def test_joints_of_hands_may_differ():
    fitted = clip_of(("hip", "left_hand_index_0")).fitted_to(("right_thumb", "hip"))
    assert fitted.dof_pos[0].tolist() == [0.0, 1.0]


def test_other_joints_are_listed_on_both_sides():
    with pytest.raises(MotionFileError, match="only the robot has knee; only the file has toe"):
        clip_of(("hip", "toe")).fitted_to(("hip", "knee"))
    fitted = clip_of(("hip", "toe")).fitted_to(("hip", "knee"), by_order=True)
    assert fitted.dof_pos[0].tolist() == [1.0, 2.0]


def test_without_names_the_number_counts():
    assert clip_of(None, 2).fitted_to(("a", "b")).joint_names == ("a", "b")
    with pytest.raises(MotionFileError, match="has 2 joints without names, the robot has 1"):
        clip_of(None, 2).fitted_to(("a",))


def test_degrees_are_refused():
    clip = clip_of(("hip", "knee", "wheel"))  # 1, 2 and 3 rad
    limits = np.array([[-1.0, 1.0], [0.0, 1.95], [-np.inf, np.inf]])
    clip.check_limits(limits)
    clip.check_limits(limits - np.array([[0.0], [0.2], [0.0]]))
    with pytest.raises(MotionFileError, match=r"hip leaves .* by up to 6\.4 rad; .* degrees"):
        clip.check_limits(limits + np.array([[6.4 + 2.0], [0.0], [0.0]]))
