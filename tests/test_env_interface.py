"""The contracts between tasks and agents: what fits, and the message for what does not."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor

import isaacgymenvs_lite
from isaacgymenvs_lite.env_interface import (
    AMPEnv,
    AMPObsEnv,
    ClipSkillEnv,
    ClipWindowsEnv,
    Env,
    HierarchyEnv,
    ReferenceEnv,
    SkillEnv,
    fits,
    require,
)
from isaacgymenvs_lite.errors import ConfigError


class OwnTask:
    """Inherits nothing."""

    amp_observation_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def fetch_amp_obs_demo(self, num_samples: int) -> Tensor:
        return torch.zeros(num_samples, 4)


def test_a_class_that_has_the_members_fits():
    task = OwnTask()
    assert require(task, AMPEnv, "AMP") is task
    assert fits(task, AMPObsEnv)
    assert not fits(task, SkillEnv)


def test_a_message_names_everything_that_is_missing():
    with pytest.raises(ConfigError) as caught:
        require(OwnTask(), ClipSkillEnv, "train.params.algo: skills")
    text = str(caught.value)
    assert text.startswith("train.params.algo: skills needs a task with reference motions")
    assert "OwnTask has no num_envs, progress_buf, amp_obs_of, fetch_amp_obs_demo_pairs" in text
    assert "task=HumanoidAMP" in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("name", "contracts"),
    [
        ("HumanoidAMP", (Env, ClipSkillEnv, ClipWindowsEnv, HierarchyEnv, ReferenceEnv)),
        ("HumanoidHeading", (Env, ClipSkillEnv, ClipWindowsEnv, HierarchyEnv, ReferenceEnv)),
        ("Cartpole", (Env,)),
    ],
)
def test_which_shipped_tasks_fit(name, contracts):
    task = isaacgymenvs_lite.make(task=name, num_envs=2)
    try:
        every = (Env, AMPEnv, SkillEnv, ClipSkillEnv, ClipWindowsEnv, HierarchyEnv, ReferenceEnv)
        expected = {base for contract in contracts for base in contract.__mro__} & set(every)
        assert {contract for contract in every if fits(task, contract)} == expected
    finally:
        task.close()
