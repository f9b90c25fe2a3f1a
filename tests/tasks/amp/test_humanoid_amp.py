"""Starts of episodes, AMP observations and demonstrations. The height of the clip tells its time.

See `walk_clip` in tests/conftest.py: 1.5 s, root height 0.88 + 0.05 t.
"""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError, MotionFileError
from isaacgymenvs_lite.motion.formats.npz import save_npz
from isaacgymenvs_lite.motion.loader import load_single_clip
from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.tasks.amp.humanoid_amp import (
    HumanoidAMP,
    build_amp_observations,
)
from isaacgymenvs_lite.tasks.base.humanoid_observations import compute_humanoid_observations

DT = 0.0332
CLIP_S = 1.5
DEFAULT_HEIGHT_M = 0.89
# float32; velocities are up to 1 m/s and 2 rad/s, and times are read off heights.
ATOL = 4e-5


def _time_of(height_m: Tensor) -> Tensor:
    """The time (s) at which the clip has these root heights; exact to 2e-6 s."""
    return (height_m.double() - 0.88) / 0.05


def _library(walk_clip: Path) -> MotionLib:
    return MotionLib(walk_clip, 28, [5, 8, 11, 14], "cpu", interpolation="spline")


def _features(library: MotionLib, times_s: Tensor, local_root_obs: bool = False) -> Tensor:
    """AMP features (n, 105) of the clip at times (n,)."""
    ids = torch.zeros(len(times_s), dtype=torch.int64)
    pos, rot, dof_pos, vel, ang_vel, dof_vel, key_pos = library.get_motion_state(ids, times_s)
    root = torch.cat((pos, rot, vel, ang_vel), dim=-1)
    return build_amp_observations(root, dof_pos, dof_vel, key_pos, local_root_obs)


def _zero_step(task: HumanoidAMP):
    return task.step(torch.zeros(task.num_envs, 28))


# --- the features -----------------------------------------------------------------------------


def test_one_step_of_the_amp_observation_is_the_policy_s() -> None:
    torch.manual_seed(0)
    root = torch.randn(6, 13)
    root[:, 3:7] /= root[:, 3:7].norm(dim=-1, keepdim=True)
    state = root, torch.randn(6, 28), torch.randn(6, 28), torch.randn(6, 4, 3)
    for local in (False, True):
        assert torch.equal(
            build_amp_observations(*state, local), compute_humanoid_observations(*state, local)
        )


# --- starts of episodes -----------------------------------------------------------------------


def test_default_start(make_humanoid) -> None:
    task = make_humanoid(3, stateInit="Default")
    task.reset_done()
    sim = task.simulation
    expected = torch.tensor([[0.0, 0.0, DEFAULT_HEIGHT_M, 0.0, 0.0, 0.0, 1.0, *[0.0] * 6]] * 3)
    torch.testing.assert_close(sim.root_states, expected, rtol=0.0, atol=1e-7)
    assert (sim.dof_pos == 0.0).all()
    assert (sim.dof_vel == 0.0).all()


def test_start_at_the_beginning_of_the_clip(make_humanoid, walk_clip: Path) -> None:
    for local_root_obs in [False, True]:
        task = make_humanoid(2, stateInit="Start", localRootObs=local_root_obs)
        observations, done_ids = task.reset_done()
        assert done_ids.tolist() == [0, 1]
        library = _library(walk_clip)
        zeros = torch.zeros(2)
        pos, rot, dof_pos, vel, ang_vel, dof_vel, key_pos = library.get_motion_state([0, 0], zeros)
        sim = task.simulation
        root = torch.cat((pos, rot, vel, ang_vel), dim=-1)
        torch.testing.assert_close(sim.root_states, root, rtol=0.0, atol=ATOL)
        torch.testing.assert_close(sim.dof_pos, dof_pos, rtol=0.0, atol=ATOL)
        torch.testing.assert_close(sim.dof_vel, dof_vel, rtol=0.0, atol=ATOL)
        # The bodies are those of the new state at once.
        torch.testing.assert_close(sim.body_pos[:, [5, 8, 11, 14]], key_pos, rtol=0.0, atol=ATOL)
        expected = _features(library, zeros, local_root_obs)
        torch.testing.assert_close(observations["obs"], expected, rtol=0.0, atol=ATOL)


def test_random_start(make_humanoid, walk_clip: Path) -> None:
    torch.manual_seed(0)
    task = make_humanoid(400, stateInit="Random")
    observed = task.reset_done()[0]["obs"]
    times = _time_of(observed[:, 0])
    assert times.min() > -1e-5
    assert times.max() < CLIP_S + 1e-5
    # Uniform over the clip: mean 0.75 s with a standard error of 1.5 / sqrt(12 * 400) = 0.022 s.
    assert abs(float(times.mean()) - 0.75) < 0.1
    assert float(times.min()) < 0.05 < CLIP_S - 0.05 < float(times.max())
    expected = _features(_library(walk_clip), times)
    torch.testing.assert_close(observed, expected, rtol=0.0, atol=ATOL)


def test_what_touches_the_ground_in_the_clip_may_do_so(
    make_humanoid, tmp_path: Path, walk_clip: Path, caplog
) -> None:
    feet = make_humanoid(1, contactBodies=None)
    assert feet.contact_body_ids.tolist() == [11, 14]
    clip = load_single_clip(walk_clip)[0]
    lying = np.array(clip.local_rotation)
    lying[:, 1:] = (0.0, 0.0, 0.0, 1.0)
    lying[:, 0] = (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))
    clip = dataclasses.replace(clip, local_rotation=lying)
    file = str(save_npz(tmp_path / "lying.npz", clip))
    with caplog.at_level(logging.INFO):
        task = make_humanoid(1, contactBodies=None, motion_file=file)
    assert task.contact_body_ids.sort().values.tolist() == list(range(15))
    assert "touch the ground in the clips may do so: pelvis, torso" in caplog.text
    given = make_humanoid(1, contactBodies=["left_foot"], motion_file=file)
    assert given.contact_body_ids.tolist() == [14]


@pytest.mark.slow
def test_episodes_start_where_they_fail(make_humanoid, tmp_path: Path, walk_clip: Path) -> None:
    """A clip that stands, and in its last third is on its back in the air."""
    clip = load_single_clip(walk_clip)[0]
    turns = np.zeros_like(clip.local_rotation)
    turns[..., 3] = 1.0
    lies = slice(30, None)
    turns[lies, 0] = (0.0, -np.sqrt(0.5), 0.0, np.sqrt(0.5))
    root = np.zeros_like(clip.root_translation)
    root[:, 2] = DEFAULT_HEIGHT_M
    poses = {"local_rotation": turns, "root_translation": root}
    file = save_npz(tmp_path / "back.npz", dataclasses.replace(clip, **poses))

    def share_of_lying_starts(adaptive: float) -> float:
        torch.manual_seed(1)
        task = make_humanoid(
            256,
            motion_file=str(file),
            clipInterpolation="published",  # a spline would swing between the two poses
            episodeLength=30,  # in which the zero pose does not yet fall over
            adaptiveStarts=adaptive,
        )
        lying, starts = 0, 0
        for step in range(180):
            _, started = task.reset_done()
            if step > 100:
                starts += len(started)
                lying += int((task.simulation.root_states[started, 4].abs() > 0.3).sum())
            _zero_step(task)
        return lying / starts

    evenly, adaptive = share_of_lying_starts(0.0), share_of_lying_starts(0.9)
    assert evenly == pytest.approx(1 / 3, abs=0.07)
    # By then each moment has had about 70 episodes, and rates of 0.5 have come to 0.13 and 0.87.
    assert adaptive > 0.6


def _starts_in_clip(task: HumanoidAMP) -> Tensor:
    """Mask (N,) of environments that do not stand in the default pose."""
    return (task.simulation.dof_pos != 0.0).any(dim=-1)


def test_hybrid_start(make_humanoid) -> None:
    for probability, tolerance in [(0.0, 0.0), (0.25, 0.1), (1.0, 0.0)]:
        # Five standard deviations of a share of 400: 5 sqrt(0.25 * 0.75 / 400) = 0.11.
        torch.manual_seed(1)
        task = make_humanoid(400, stateInit="Hybrid", hybridInitProb=probability)
        task.reset_done()
        in_clip = _starts_in_clip(task)
        assert abs(float(in_clip.float().mean()) - probability) <= tolerance
        heights = task.simulation.root_states[:, 2]
        torch.testing.assert_close(
            heights[~in_clip], torch.full_like(heights[~in_clip], DEFAULT_HEIGHT_M)
        )


# --- the history of AMP observations ----------------------------------------------------------


def test_history_of_a_default_start_repeats_the_first_observation(make_humanoid) -> None:
    for steps in [2, 4]:
        task = make_humanoid(2, stateInit="Default", numAMPObsSteps=steps)
        first = task.reset_done()[0]["obs"]
        seen = [first]
        for count in range(1, steps + 2):
            observations, *_, infos = _zero_step(task)
            seen.insert(0, observations["obs"])
            history = infos["amp_obs"].view(2, steps, 105)
            for slot in range(steps):
                # newest first; before the start the character stood still
                expected = seen[slot] if slot <= count else first
                assert torch.equal(history[:, slot], expected), (count, slot)


def test_history_of_a_start_in_the_clip_is_the_clip_s(make_humanoid, walk_clip: Path) -> None:
    for steps in [2, 4]:
        for local_root_obs in [False, True]:
            torch.manual_seed(2)
            task = make_humanoid(60, numAMPObsSteps=steps, localRootObs=local_root_obs)
            observed = task.reset_done()[0]["obs"]
            times = _time_of(observed[:, 0])
            infos = _zero_step(task)[-1]
            history = infos["amp_obs"].view(60, steps, 105)
            # After one step slot 1 is the start, slot k + 1 the clip k control steps earlier; times
            # before its beginning extrapolate.
            torch.testing.assert_close(history[:, 1], observed, rtol=0.0, atol=0.0)
            library = _library(walk_clip)
            for k in range(1, steps - 1):
                expected = _features(library, times - k * DT, local_root_obs)
                torch.testing.assert_close(history[:, k + 1], expected, rtol=0.0, atol=ATOL)
            assert times.min() < DT


def test_a_reset_leaves_the_history_of_the_others(make_humanoid) -> None:
    # In IsaacGymEnvs a later reset wrote over the history of environments still running.
    torch.manual_seed(3)
    task = make_humanoid(40, stateInit="Hybrid", numAMPObsSteps=4)
    task.reset_done()
    for _ in range(2):
        _zero_step(task)
    everyone = torch.arange(40)
    # many, then single ones, of which about half start in the clip
    for env_ids in torch.arange(28).split([20, *[1] * 8]):
        before = task.amp_obs_of(everyone)
        task.reset_idx(env_ids)
        others = torch.ones(40, dtype=torch.bool)
        others[env_ids] = False
        after = task.amp_obs_of(everyone)
        assert torch.equal(after[others], before[others])
        assert (after != before).any(dim=1)[env_ids].all()
        _zero_step(task)


def test_the_terminal_observation_is_seen_before_the_reset(make_humanoid) -> None:
    task = make_humanoid(2, stateInit="Start", episodeLength=3, enableEarlyTermination=False)
    task.reset_done()
    first, *_, infos = _zero_step(task)
    last, _, dones, infos = _zero_step(task)
    assert dones.tolist() == [1, 1]
    assert infos["terminate"].tolist() == [0, 0]
    assert infos["time_outs"].tolist() == [True, True]
    history = infos["amp_obs"].view(2, 2, 105)
    assert torch.equal(history[:, 0], last["obs"])
    assert torch.equal(history[:, 1], first["obs"])
    fresh = task.reset_done()[0]["obs"]
    torch.testing.assert_close(fresh[:, 0], torch.full((2,), 0.88), rtol=0.0, atol=1e-6)
    # what the agent holds stays
    assert torch.equal(infos["amp_obs"].view(2, 2, 105), history)


# --- demonstrations ---------------------------------------------------------------------------


def test_demonstrations_lie_inside_the_clip(make_humanoid, walk_clip: Path) -> None:
    for steps, local_root_obs in [(2, False), (4, True)]:
        torch.manual_seed(4)
        task = make_humanoid(1, numAMPObsSteps=steps, localRootObs=local_root_obs)
        demos = task.fetch_amp_obs_demo(300)
        assert (demos.shape, demos.dtype) == ((300, steps * 105), torch.float32)
        demos = demos.view(300, steps, 105)
        newest, oldest = _time_of(demos[:, 0, 0]), _time_of(demos[:, -1, 0])
        assert oldest.min() > -1e-5
        assert newest.max() < CLIP_S + 1e-5
        # The whole of the clip is used.
        assert oldest.min() < 0.05
        assert newest.max() > CLIP_S - 0.05
        library = _library(walk_clip)
        for k in range(steps):
            expected = _features(library, newest - k * DT, local_root_obs)
            torch.testing.assert_close(demos[:, k], expected, rtol=0.0, atol=ATOL)


def test_pairs_of_demonstrations_are_near_each_other_inside_the_clip(make_humanoid) -> None:
    torch.manual_seed(4)
    task = make_humanoid(1)
    pairs = task.fetch_amp_obs_demo_pairs(300, apart_s=0.2)
    assert (pairs.shape, pairs.dtype) == ((300, 2, 210), torch.float32)
    first, second = _time_of(pairs[:, 0, 0]), _time_of(pairs[:, 1, 0])
    apart_s = (second - first).abs()
    assert apart_s.max() < 0.2 + 1e-5
    assert apart_s.max() > 0.19
    assert apart_s.mean() > 0.08
    assert min(first.min(), second.min()) > DT - 1e-5  # the history lies inside, too
    assert max(first.max(), second.max()) < CLIP_S + 1e-5
    # Far more than the clip's length apart: the clip's ends.
    ends = _time_of(task.fetch_amp_obs_demo_pairs(300, apart_s=1000.0)[:, 1, 0])
    assert ((ends - DT).abs().minimum((ends - CLIP_S).abs()) < 1e-4).float().mean() > 0.9


# --- bad input --------------------------------------------------------------------------------


def test_a_missing_motion_file(make_humanoid, tmp_path: Path) -> None:
    with pytest.raises(MotionFileError, match=r"motion file '.*nowhere\.npz' not found") as error:
        make_humanoid(1, motion_file=str(tmp_path / "nowhere.npz"))
    assert "\n" not in str(error.value)


def test_bad_values_are_config_errors(make_humanoid) -> None:
    for key, value in [("stateInit", "Sitting"), ("numAMPObsSteps", 1), ("hybridInitProb", 2.0)]:
        with pytest.raises(ConfigError, match=rf"task\.env\.{key}"):
            make_humanoid(1, **{key: value})


def test_the_shown_actions_follow_the_clip(make_task) -> None:
    """A step with them ends nearer to the clip than one with targets at its pose, or none."""
    task = make_task("task=HumanoidAMP", "task.env.motion_file=walk", num_envs=64)
    task.reset()
    torch.manual_seed(0)
    demo = task.fetch_tracking_demo(64)
    obs, actions = demo.obs, demo.actions
    assert obs.shape == (64, task.num_obs)
    assert float(actions.abs().max()) <= 1.0
    lib, dt_s = task.motion_lib, task.control_dt_s
    torch.manual_seed(0)  # the same moments once more
    motion_ids = lib.sample_motions(64)
    times = lib.sample_time(motion_ids, truncate_time=3 * dt_s)
    zero, one = (lib.get_motion_state(motion_ids, times + after * dt_s) for after in (0, 1))
    root = torch.cat((zero.root_pos, zero.root_rot, zero.root_vel, zero.root_ang_vel), dim=-1)
    scaling = task.action_scaling()
    at_pose = (zero.dof_pos - scaling.offset) / scaling.scale
    errors = []
    for chosen in (actions, at_pose, torch.zeros_like(actions)):
        task.simulation.write_state(torch.arange(64), root, zero.dof_pos, zero.dof_vel)
        task.step(chosen)
        errors.append(float((task.simulation.dof_pos - one.dof_pos).square().mean()) ** 0.5)
    shown, held, none = errors
    assert shown < 0.7 * held < none
    task.simulation.write_state(torch.arange(64), root, zero.dof_pos, zero.dof_vel)
    torch.testing.assert_close(task.compute_obs(), obs, atol=2e-3, rtol=0)
    # The newest step of the AMP observation is of the same moment.
    torch.testing.assert_close(demo.amp_obs[:, : obs.shape[1]], obs)
