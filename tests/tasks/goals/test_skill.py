"""The goal `skill`: commands that the first entries of latents issue."""

from __future__ import annotations

import math

import pytest
import torch

from isaacgymenvs_lite.utils.rotations import planar_motion

SCALES = torch.tensor([0.2, 0.6, 0.3])


def _commands(make_ase, clip: str) -> torch.Tensor:
    task = make_ase(4, goal="skill", motion_file=clip, numAMPObsSteps=2)
    amp_obs, commands = task.fetch_commanded_demos(200)
    assert amp_obs.shape == (200, task.num_amp_obs)
    assert commands.shape == (200, task.num_skill_commands)
    return commands


def test_commands_are_means_of_the_clip_over_a_second(make_ase) -> None:
    torch.manual_seed(0)
    # docs/shipped_clips.md: a backward walk of 0.94 m/s, and a turn in place of 110 degrees/s.
    back = (_commands(make_ase, "walk_backward.npz") / SCALES).median(0).values
    assert back[0].item() == pytest.approx(-0.94, abs=0.05)
    assert back[1:3].abs().max() < 0.1
    turn = (_commands(make_ase, "turn_left_fast.npz") / SCALES).median(0).values
    assert turn[2].item() == pytest.approx(math.radians(110), abs=0.1)
    # A latent is a unit vector, and has room for a command.
    for clip in ("run.npz", "turn_left_fast.npz"):
        assert _commands(make_ase, clip).norm(dim=-1).max() < 0.8


def test_the_reward_is_the_share_of_the_command_that_is_shown(make_ase) -> None:
    torch.manual_seed(0)
    task = make_ase(3, goal="skill", stateInit="Default")
    task.reset_done()
    # To stand, to walk backward, to turn.
    asked = torch.tensor([[0.0, 0.0, 0.0], [-0.9, 0.0, 0.0], [0.0, 0.0, 1.9]])
    task.command_skills(torch.arange(3), asked * SCALES)
    motions = []
    for _ in range(5):
        task.step(torch.zeros(3, task.num_actions))
        motions.append(planar_motion(task.simulation.root_states))
    rewards = task.goal.reward()["pace"]
    motion = torch.stack(motions).mean(0)
    metres = torch.tensor([1.0, 1.0, 1.0 / math.radians(100)])  # 100 degrees count as 1 m
    missed, pace = ((rows * metres).norm(dim=-1) for rows in (asked - motion, asked))
    expected = (1.0 - missed / pace.clamp(min=0.3)).clamp(min=0.0)
    torch.testing.assert_close(rewards, expected, rtol=0.0, atol=1e-3)
    assert rewards[1] < 0.2  # a character that stands shows next to nothing of a walk
