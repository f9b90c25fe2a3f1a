"""What the policy and the discriminator of ASE's humanoids observe.

See `walk_clip` in tests/conftest.py: 1.5 s, root height 0.88 + 0.05 t tells the time.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.tasks.amp.humanoid_amp import build_amp_observations
from isaacgymenvs_lite.tasks.ase.humanoid_ase import HumanoidASE
from isaacgymenvs_lite.tasks.base.humanoid_observations import compute_all_body_observations

DT = 1.0 / 30.0
# float32 of numbers of order 1
ATOL = 1e-6
# float32; times are read off heights, to 2e-6 s, and velocities are up to 1 m/s and 2 rad/s.
CLIP_ATOL = 4e-5
KEY_BODIES = {28: [5, 8, 11, 14], 31: [5, 10, 13, 16, 6, 9]}
IDENTITY = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
QUARTER_TURN_LEFT = [0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
both_bodies = pytest.mark.parametrize("armed", [False, True])


def _policy_features(task: HumanoidASE, local_root_obs: bool = True, height: bool = True) -> Tensor:
    sim = task.simulation
    bodies = (sim.body_pos, sim.body_rot, sim.body_lin_vel, sim.body_ang_vel)
    return compute_all_body_observations(*bodies, local_root_obs, height)


def _amp_features(task: HumanoidASE) -> Tensor:
    sim = task.simulation
    key_pos = sim.body_pos[:, KEY_BODIES[task.num_actions]]
    return build_amp_observations(
        sim.root_states, sim.dof_pos, sim.dof_vel, key_pos, True, as_ase=True
    )


def _library(task: HumanoidASE, clip: Path) -> MotionLib:
    keys = KEY_BODIES[task.num_actions]
    return MotionLib(clip, task.num_actions, keys, "cpu", interpolation="spline")


def _clip_features(library: MotionLib, times_s: Tensor) -> Tensor:
    """AMP features of the clip at times (n,), without heading."""
    ids = torch.zeros(len(times_s), dtype=torch.int64)
    pos, rot, dof_pos, vel, ang_vel, dof_vel, key_pos = library.get_motion_state(ids, times_s)
    root = torch.cat((pos, rot, vel, ang_vel), dim=-1)
    return build_amp_observations(root, dof_pos, dof_vel, key_pos, True, as_ase=True)


def _face_left(task: HumanoidASE) -> None:
    """Turn all characters, in the default pose, a quarter turn to the left."""
    n, sim = task.num_envs, task.simulation
    root = sim.root_states.clone()
    root[:, 3:7] = torch.tensor([0.0, 0.0, 0.5**0.5, 0.5**0.5])
    zeros = torch.zeros(n, task.num_actions)
    sim.write_state(torch.arange(n), root, zeros, zeros)


def _random_steps(task: HumanoidASE, count: int):
    generator = torch.Generator().manual_seed(0)
    for _ in range(count):
        yield task.step(0.5 * torch.randn(task.num_envs, task.num_actions, generator=generator))


# --- the policy's observation -----------------------------------------------------------------


def test_observation_of_the_default_pose(make_ase) -> None:
    observed = make_ase(2, stateInit="Default").reset()["obs"]
    positions = torch.zeros(15, 3)
    # Offsets of torso, upper arm, lower arm and hand added up; of thigh, shin and foot.
    hand_z = 0.236151 + 0.24350 - 0.274788 - 0.258947
    positions[1] = torch.tensor([0.0, 0.0, 0.236151])
    positions[2] = torch.tensor([0.0, 0.0, 0.236151 + 0.223894])
    for first, side in ((3, -1.0), (6, 1.0)):
        positions[first : first + 3] = torch.tensor([-0.02405, side * 0.18311, hand_z])
        positions[first, 2] += 0.274788 + 0.258947
        positions[first + 1, 2] += 0.258947
    for first, side in ((9, -1.0), (12, 1.0)):
        for body, z in zip(range(first, first + 3), (0.0, -0.421546, -0.831416), strict=True):
            positions[body] = torch.tensor([0.0, side * 0.084887, z])
    expected = [0.89, *positions[1:].flatten().tolist(), *IDENTITY * 15, *[0.0] * 90]
    torch.testing.assert_close(observed, torch.tensor([expected] * 2), rtol=0.0, atol=ATOL)


@both_bodies
def test_observation_after_steps_is_that_of_the_state(make_ase, armed) -> None:
    for local_root_obs in [False, True]:
        task = make_ase(3, armed=armed, localRootObs=local_root_obs)
        task.reset()
        *_, (observations, *_) = _random_steps(task, 4)
        expected = _policy_features(task, local_root_obs)
        torch.testing.assert_close(observations["obs"], expected, rtol=0.0, atol=ATOL)


def test_the_goal_comes_last(make_ase) -> None:
    task = make_ase(3, goal="location")
    told = make_ase(3, goal="location", enableTaskObs=False)
    for one in (task, told):
        torch.manual_seed(0)
        one.reset()
    (observations, *_), (without, *_) = (next(_random_steps(one, 1)) for one in (task, told))
    observed = observations["obs"]
    torch.testing.assert_close(observed[:, :223], _policy_features(task), rtol=0.0, atol=ATOL)
    torch.testing.assert_close(observed[:, 223:], task.goal.observe(None), rtol=0.0, atol=ATOL)
    assert torch.equal(without["obs"], observed[:, :223])


def test_local_root_obs_means_the_opposite_for_the_policy(make_ase) -> None:
    for local_root_obs in [False, True]:
        task = make_ase(1, stateInit="Default", localRootObs=local_root_obs)
        ahead = task.reset()["obs"][0]
        _face_left(task)
        task.compute_observations()
        left = task.obs_buf[0]
        # After 1 height and 14 positions: six numbers of the root, 84 of the others.
        turned = torch.tensor(QUARTER_TURN_LEFT if local_root_obs else IDENTITY)
        torch.testing.assert_close(left[43:49], turned, rtol=0.0, atol=ATOL)
        torch.testing.assert_close(left[:43], ahead[:43], rtol=0.0, atol=ATOL)
        torch.testing.assert_close(left[49:], ahead[49:], rtol=0.0, atol=ATOL)
        seen = torch.tensor(IDENTITY if local_root_obs else QUARTER_TURN_LEFT)
        torch.testing.assert_close(task.current_amp_features()[0, 1:7], seen, rtol=0.0, atol=ATOL)


def test_root_height_obs_hides_the_height_everywhere(make_ase) -> None:
    task = make_ase(8, stateInit="Random", rootHeightObs=False)
    observed = task.reset()["obs"]
    assert (observed[:, 0] == 0.0).all()
    torch.testing.assert_close(observed, _policy_features(task, height=False), rtol=0, atol=ATOL)
    *_, (observations, *_, infos) = _random_steps(task, 2)
    assert (observations["obs"][:, 0] == 0.0).all()
    history, demos = infos["amp_obs"].view(8, 10, 125), task.fetch_amp_obs_demo(8).view(8, 10, 125)
    assert (history[..., 0] == 0.0).all()
    assert (demos[..., 0] == 0.0).all()
    torch.testing.assert_close(history[:, 0, 1:], _amp_features(task)[:, 1:], rtol=0, atol=ATOL)


# --- the AMP observation ----------------------------------------------------------------------


@both_bodies
def test_history_of_a_start_in_the_clip_is_the_clip_s(
    make_ase, walk_clip: Path, armed_walk_clip: Path, armed: bool
) -> None:
    torch.manual_seed(2)
    task = make_ase(16, armed=armed, stateInit="Random")
    observed = task.reset_done()[0]["obs"]
    start = _amp_features(task)
    times = (observed[:, 0].double() - 0.88) / 0.05
    history = next(_random_steps(task, 1))[-1]["amp_obs"].view(16, 10, -1)
    torch.testing.assert_close(history[:, 1], start, rtol=0.0, atol=ATOL)
    library = _library(task, armed_walk_clip if armed else walk_clip)
    for k in range(1, 9):
        # Times before the beginning of the clip extrapolate.
        expected = _clip_features(library, times - k * DT)
        torch.testing.assert_close(history[:, k + 1], expected, rtol=0.0, atol=CLIP_ATOL)
    assert times.min() < 8 * DT


# --- demonstrations ---------------------------------------------------------------------------
