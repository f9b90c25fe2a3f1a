from __future__ import annotations

import logging
import re

import pytest
import torch

pytest.importorskip("skrl")

import isaacgymenvs_lite
from isaacgymenvs_lite.workflows.skrl.agent import ProgressLines
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask


def test_lines_have_steps_and_episodes(caplog):
    caplog.set_level(logging.INFO)
    task = isaacgymenvs_lite.make(
        seed=1, task="Cartpole", num_envs=4, sim_device="cpu", rl_device="cpu"
    )
    stepper = AutoresetTask(task, "test")
    progress = ProgressLines(stepper, 200, interval_s=0.0)
    task.listeners.append(progress)
    stepper.reset()
    push = torch.ones(4, 1)
    for _ in range(80):  # pushed to one side, poles fall within some dozen steps
        stepper.step(push)
    task.close()
    lines = [record.getMessage() for record in caplog.records if "step " in record.getMessage()]
    assert len(lines) == 80
    assert re.fullmatch(r"step 1/200, fps [\d,]+", lines[0])
    last = re.fullmatch(
        r"step 80/200, fps [\d,]+, episode length (\d+), reward (-?[\d.]+)", lines[-1]
    )
    assert last is not None
    assert 5 < int(last[1]) < 60


def test_lines_are_rare(caplog):
    caplog.set_level(logging.INFO)
    task = isaacgymenvs_lite.make(
        seed=1, task="Cartpole", num_envs=4, sim_device="cpu", rl_device="cpu"
    )
    stepper = AutoresetTask(task, "test")
    task.listeners.append(ProgressLines(stepper, 200, interval_s=3600.0))
    stepper.reset()
    for _ in range(5):
        stepper.step(torch.zeros(4, 1))
    task.close()
    assert not [record for record in caplog.records if record.getMessage().startswith("step ")]
