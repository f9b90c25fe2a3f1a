from pathlib import Path

import numpy as np
import pytest

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.skeleton import (
    Skeleton,
    shipped_humanoid_with,
    skeleton_for_num_dofs,
)


def test_humanoid_has_the_published_body_plan(humanoid: Skeleton) -> None:
    assert humanoid.body_names == (
        "pelvis",
        "torso",
        "head",
        "right_upper_arm",
        "right_lower_arm",
        "right_hand",
        "left_upper_arm",
        "left_lower_arm",
        "left_hand",
        "right_thigh",
        "right_shin",
        "right_foot",
        "left_thigh",
        "left_shin",
        "left_foot",
    )
    assert humanoid.parent_indices == (-1, 0, 1, 1, 3, 4, 1, 6, 7, 0, 9, 10, 0, 12, 13)
    assert humanoid.dof_body_ids == (1, 2, 3, 4, 6, 7, 9, 10, 11, 12, 13, 14)
    assert humanoid.dof_offsets == (0, 3, 6, 9, 10, 13, 14, 17, 18, 21, 24, 25, 28)
    assert (humanoid.num_bodies, humanoid.num_dofs) == (15, 28)
    np.testing.assert_allclose(humanoid.local_translation[3], (-0.02405, -0.18311, 0.2435))


def test_foot_corners_are_those_of_the_foot_boxes(humanoid: Skeleton) -> None:
    # Box centre (0.045, 0, -0.0225), half sizes (0.0885, 0.045, 0.0275) m.
    assert humanoid.foot_body_ids == (11,) * 8 + (14,) * 8
    np.testing.assert_allclose(humanoid.foot_corners[:8].min(axis=0), (-0.0435, -0.045, -0.05))
    np.testing.assert_allclose(humanoid.foot_corners[:8].max(axis=0), (0.1335, 0.045, 0.005))


def test_humanoid_with_sword_and_shield_has_the_published_body_plan(
    humanoid: Skeleton, armed: Skeleton
) -> None:
    assert armed.body_names == (
        *humanoid.body_names[:6],
        "sword",
        "left_upper_arm",
        "left_lower_arm",
        "shield",
        "left_hand",
        *humanoid.body_names[9:],
    )
    assert armed.parent_indices == (-1, 0, 1, 1, 3, 4, 5, 1, 7, 8, 8, 0, 11, 12, 0, 14, 15)
    assert armed.dof_body_ids == (1, 2, 3, 4, 5, 7, 8, 11, 12, 13, 14, 15, 16)
    assert armed.dof_offsets == (0, 3, 6, 9, 10, 13, 16, 17, 20, 21, 24, 27, 28, 31)
    assert (armed.num_bodies, armed.num_dofs) == (17, 31)
    assert armed.foot_body_ids == (13,) * 8 + (16,) * 8


def test_unknown_number_of_dofs_lists_the_choices() -> None:
    with pytest.raises(ConfigError, match=r"no humanoid with 30 .* choices: 28, 31;"):
        skeleton_for_num_dofs(30)


def test_a_humanoid_is_known_by_its_bodies(humanoid: Skeleton, armed: Skeleton) -> None:
    assert shipped_humanoid_with(humanoid.body_names) == "mjcf/amp_humanoid.xml"
    names = armed.body_names[::-1]
    assert shipped_humanoid_with(names) == "mjcf/amp_humanoid_sword_shield.xml"
    assert shipped_humanoid_with(names[1:]) is None


def test_files_without_a_skeleton_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "model.xml"
    for free, joint, message in (
        ("<freejoint/>", '<joint name="bad" type="slide"/>', r"joint 'bad' is a slide; .* fixes"),
        ("", '<joint name="bad"/>', "its first joint is not the free joint of a root"),
        ("", "<joint", "no model that can be used"),
    ):
        path.write_text(
            f'<mujoco><worldbody><body name="root">{free}<geom size="0.1"/>'
            f'<body name="arm">{joint}<geom size="0.1"/></body></body></worldbody></mujoco>'
        )
        with pytest.raises(ConfigError, match=message):
            Skeleton.from_mjcf(path)
