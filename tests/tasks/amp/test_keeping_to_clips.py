"""Episodes of HumanoidAMP that keep to their clip, and end where they leave it or it is over.

See `walk_clip` in tests/conftest.py: 1.5 s, and its end is near its start.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.evaluation.evaluate import evaluate
from isaacgymenvs_lite.motion.formats.npz import save_npz
from isaacgymenvs_lite.motion.loader import load_single_clip
from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP
from isaacgymenvs_lite.utils.rotations import quat_mul

DT = 0.0332
CLIP_S = 1.5


def _zero_step(task: HumanoidAMP):
    return task.step(torch.zeros(task.num_envs, 28))


def _in_training(make_humanoid: Any, num_envs: int, **env: Any) -> HumanoidAMP:
    """Return a task in training, whose first episodes have begun."""
    torch.manual_seed(3)
    task = make_humanoid(num_envs, **env)
    task.is_training = True
    task.reset_done()
    return task


def _raise_first(task: HumanoidAMP) -> None:
    """Put the first character half a metre above where it is."""
    root = task.simulation.root_states[:1].clone()
    root[:, 2] += 0.5
    _put_first(task, root)


def _put_first(task: HumanoidAMP, root: Tensor) -> None:
    """Give the first character a root state (1, 13)."""
    sim = task.simulation
    sim.write_state(torch.tensor([0]), root, sim.dof_pos[:1].clone(), sim.dof_vel[:1].clone())


def test_an_episode_ends_where_it_strays_from_the_clip_that_it_started_in(make_humanoid) -> None:
    task = _in_training(make_humanoid, 4, clipDeviation=0.3, stateInit="Start")
    _raise_first(task)
    *_, dones, infos = _zero_step(task)
    assert dones.tolist() == [1, 0, 0, 0]
    assert infos["off_clip"].tolist() == [True, False, False, False]
    task.reset_done()
    assert _zero_step(task)[2].tolist() == [0, 0, 0, 0]


@pytest.mark.slow
def test_it_goes_on_where_straying_does_not_count(make_humanoid) -> None:
    for env, is_training in [
        ({}, True),  # off where the task is made without the YAML file
        ({"clipDeviation": 0.8}, True),  # of 0.89 m: more than half a metre
        ({"clipDeviation": 0.3, "stateInit": "Default"}, True),
        ({"clipDeviation": 0.3, "enableEarlyTermination": False}, True),
        ({"clipDeviation": 0.3}, False),  # played, or stepped by a loop that does not say so
        ({"clipDeviation": 0.3, "motion_file": "locomotion"}, True),  # several clips
    ]:
        torch.manual_seed(3)
        task = make_humanoid(2, **{"stateInit": "Start", **env})
        task.is_training = is_training
        task.reset_done()
        _raise_first(task)
        assert _zero_step(task)[2].tolist() == [0, 0]


def test_only_episodes_that_are_to_keep_to_their_clips_end(make_humanoid) -> None:
    """Of several clips, or of one that is left again."""
    for motion_file in ["walk", "locomotion"]:
        torch.manual_seed(3)
        task = make_humanoid(2, clipDeviation=0.3, stateInit="Start", motion_file=motion_file)
        task.is_training = True
        for followed in (True, False):
            task.reset()
            task.leave_clips(torch.tensor([0, 1]))
            task.keep_to_clips(torch.tensor([0] if followed else []).long())
            _raise_first(task)
            assert _zero_step(task)[2].tolist() == [followed, 0]


@pytest.fixture
def rising_clip(tmp_path: Path, walk_clip: Path) -> str:
    """The walk, at whose end the character is half a metre above the ground."""
    clip = load_single_clip(walk_clip)[0]
    root = np.array(clip.root_translation)
    root[:, 2] += np.linspace(0.0, 0.5, len(root))
    rising = dataclasses.replace(clip, root_translation=root)
    return str(save_npz(tmp_path / "rising.npz", rising))


def _put_into_clip(task: HumanoidAMP, env_ids: Tensor) -> None:
    """Put characters (n,) where the clip of their start is at the end of the next step."""
    starts_s = task.clip_starts_s
    assert starts_s is not None
    at_s = starts_s[env_ids] + (task.progress_buf[env_ids] + 1) * task.control_dt_s
    state = task.motion_lib.get_motion_state(torch.zeros_like(env_ids), at_s)
    pos, rot, dof_pos, vel, ang_vel, dof_vel, _ = state
    root = torch.cat((pos, rot, vel, ang_vel), dim=-1)
    task.simulation.write_state(env_ids, root, dof_pos, dof_vel)


@pytest.mark.slow
def test_an_episode_ends_with_a_clip_that_does_not_return(
    make_humanoid, rising_clip: str, caplog
) -> None:
    """The first half of the characters follow it, at its tempo; the others stand, and wait."""
    torch.manual_seed(3)
    keys = {"clipDeviation": 0.34, "endWithClip": True, "enableEarlyTermination": False}
    with caplog.at_level(logging.INFO):
        task = make_humanoid(32, motion_file=rising_clip, clipTempo=0.3, **keys)
    most = math.ceil(1.3 * CLIP_S / DT) + 1
    assert f"episodes end with it, after at most {most} control steps" in caplog.text
    task.reset()
    starts_s = task.clip_starts_s.clone()
    assert starts_s.max() < CLIP_S - 0.5 + 1e-6
    steps = torch.zeros(32)
    for step in range(1, most):
        _put_into_clip(task, torch.arange(16))
        *_, dones, infos = _zero_step(task)
        assert not infos["terminate"].any()
        assert torch.equal(infos["time_outs"], dones.bool())
        steps[(dones == 1) & (steps == 0)] = step
    # The search goes by half a step, and the end of the clip may be near before it is there.
    late_s = starts_s[:16] + steps[:16] * DT - CLIP_S
    assert late_s.abs().max() < 3 * DT
    # Half of the clip's tempo is the least that is followed, where poses are not alike.
    at_the_clips_tempo = (CLIP_S - starts_s[16:]) / DT
    assert (steps[16:] > 1.2 * at_the_clips_tempo).all()
    assert steps.max() == most - 1


def test_what_is_left_of_a_clip_is_measured(make_humanoid, rising_clip: str) -> None:
    """Characters that stay below show less of it; those put where it is show all."""
    keys = {"clipDeviation": 0.34, "endWithClip": True, "enableEarlyTermination": False}
    task = make_humanoid(8, motion_file=rising_clip, **keys)

    def follow(obs: dict[str, Tensor]) -> Tensor:
        _put_into_clip(task, torch.arange(8))
        return torch.zeros(8, 28)

    torch.manual_seed(5)
    followed = evaluate(task, follow, 8).imitation
    left = evaluate(task, lambda obs: torch.zeros(8, 28), 8).imitation
    assert followed is not None
    assert left is not None
    assert followed.motion_shown > 0.8
    assert left.motion_shown < 0.5
    assert followed.no_fall_share == 1.0


def test_a_character_that_stands_strays_from_a_jump(make_humanoid) -> None:
    """And one that follows the clip, turned about z and ahead of it, does not."""
    task = _in_training(make_humanoid, 2, clipDeviation=0.25, stateInit="Start", motion_file="jump")
    lib, sim, dt_s = task.motion_lib, task.simulation, task.control_dt_s
    turn = torch.tensor([[0.0, 0.0, 1.0, 0.0]])  # half a turn, xyzw
    standing = [sim.root_states[1:].clone(), sim.dof_pos[1:].clone(), sim.dof_vel[1:].clone()]
    ended = []
    for step in range(40):
        time_s = torch.tensor([1.3 * step * dt_s])
        root_pos, root_rot, dof_pos, root_vel, root_ang_vel, dof_vel, _ = lib.get_motion_state(
            torch.zeros(1, dtype=torch.int64), time_s
        )
        root_rot = quat_mul(turn, root_rot)
        root = torch.cat((root_pos, root_rot, -root_vel, -root_ang_vel), dim=-1)
        states = [torch.cat(pair) for pair in zip((root, dof_pos, dof_vel), standing, strict=True)]
        sim.write_state(torch.arange(2), *states)
        ended.append(_zero_step(task)[2].tolist())
    assert not any(followed for followed, _ in ended)
    assert any(stood for _, stood in ended)


def test_a_walk_on_the_spot_strays_by_its_travel(make_humanoid) -> None:
    """Both characters have the poses of the walk; the first goes where it goes, turned about z."""
    for share, ends in [(0.5, True), (0.0, False)]:
        keys = {"clipDeviation": 0.34, "clipTravel": share, "stateInit": "Start"}
        task = _in_training(make_humanoid, 2, motion_file="walk", **keys)
        turn = torch.tensor([[0.0, 0.0, 1.0, 0.0]])  # half a turn, xyzw
        ended = []
        for step in range(40):
            time_s = torch.tensor([step * task.control_dt_s])
            root_pos, root_rot, dof_pos, root_vel, root_ang_vel, dof_vel, _ = (
                task.motion_lib.get_motion_state(torch.zeros(1, dtype=torch.int64), time_s)
            )
            half_turned = root_pos * torch.tensor([-1.0, -1.0, 1.0])
            on_the_spot = root_pos * torch.tensor([0.0, 0.0, 1.0])
            roots = [
                torch.cat((place, quat_mul(turn, root_rot), -root_vel, -root_ang_vel), dim=-1)
                for place in (half_turned, on_the_spot)
            ]
            both = (torch.cat(roots), dof_pos.expand(2, -1), dof_vel.expand(2, -1))
            task.simulation.write_state(torch.arange(2), *both)
            ended.append(_zero_step(task)[2].tolist())
        assert not any(followed for followed, _ in ended)
        assert any(stayed for _, stayed in ended) is ends
        assert not any(stayed for _, stayed in ended[:30])  # a second


@pytest.mark.slow
def test_a_walk_strays_by_its_tempo(make_humanoid) -> None:
    """The first character has the poses of the walk at its tempo, the second at another."""
    for tempo, share, ends in [(0.6, 0.3, True), (1.5, 0.3, True), (1.5, 0.0, False)]:
        keys = {"clipDeviation": 0.34, "clipTempo": share, "stateInit": "Start"}
        task = _in_training(make_humanoid, 2, motion_file="walk", **keys)
        for _ in range(2):  # long episodes, after which the limit is narrow
            _show_walk(task, torch.ones(2), 250)
            task.reset_idx(torch.arange(2))
        ended = _show_walk(task, torch.tensor([1.0, tempo]), 40)
        assert not any(at_its_tempo for at_its_tempo, _ in ended)
        assert any(at_another for _, at_another in ended) is ends
        assert not any(at_another for _, at_another in ended[:25])  # less than a second


def _show_walk(task: HumanoidAMP, tempos: Tensor, steps: int) -> list[list[bool]]:
    """Give the two characters the poses of the walk from its start on; return which end, (T, 2)."""
    ended = []
    for step in range(steps):
        root_pos, root_rot, dof_pos, root_vel, root_ang_vel, dof_vel, _ = (
            task.motion_lib.get_motion_state(
                torch.zeros(2, dtype=torch.int64), tempos * step * task.control_dt_s
            )
        )
        root = torch.cat((root_pos, root_rot, root_vel, root_ang_vel), dim=-1)
        task.simulation.write_state(torch.arange(2), root, dof_pos, dof_vel)
        ended.append(_zero_step(task)[2].tolist())
    return ended
