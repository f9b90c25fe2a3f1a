from __future__ import annotations

import pytest

from isaacgymenvs_lite.errors import SweepError
from isaacgymenvs_lite.run.observers import MEAN_REWARD, POSE_ERROR, objective_of


def test_the_pose_error_counts_where_only_clips_are_learned():
    for config, has_pose_error, expected in [
        ({"task_reward_w": 0.0}, True, POSE_ERROR),  # AMP
        ({"task_reward_w": 0}, False, MEAN_REWARD),  # ... with imitation_frequency: 0
        ({"task_reward_w": 0.9}, True, MEAN_REWARD),  # a hierarchy
        ({}, True, MEAN_REWARD),  # PPO on a task with clips
        ({}, False, MEAN_REWARD),
    ]:
        assert objective_of(config, has_pose_error) is expected


def test_a_study_optimises_in_the_right_direction():
    for objective, direction in ((POSE_ERROR, "minimize"), (MEAN_REWARD, "maximize")):
        objective.check_direction("", "Ant")
        objective.check_direction(direction, "Ant")
    with pytest.raises(SweepError, match=r"Ant returns its best mean reward; .*=maximize$"):
        MEAN_REWARD.check_direction("minimize", "Ant")
    with pytest.raises(SweepError, match=r"best pose error; .*=minimize$"):
        POSE_ERROR.check_direction("maximize", "HumanoidAMP")
