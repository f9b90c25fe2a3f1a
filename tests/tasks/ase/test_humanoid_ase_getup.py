"""HumanoidASEGetup: episodes that begin, or go on, on the ground."""

from __future__ import annotations

import pytest
import torch

from isaacgymenvs_lite.tasks.ase.humanoid_ase_getup import HumanoidASEGetup
from isaacgymenvs_lite.tasks.base.humanoid_observations import compute_humanoid_observations
from isaacgymenvs_lite.tasks.base.vec_task import Done

# float32 of numbers of order 1
ATOL = 1e-6
# The root of a standing character is at 0.89 m; lying on the back it is at 0.09 m, on a bent leg
# or on the hands higher.
LYING_M = 0.6
NORMAL_HEIGHT_M = 0.89
# Above the root in amp_humanoid.xml: the torso at 0.236151 m, on it the head at 0.223894 m.
STANDING_HEAD_M = NORMAL_HEIGHT_M + 0.236151 + 0.223894


@pytest.fixture
def make(make_ase):
    """Return `make(num_envs=4, recover=0.0, fall=0.0, **env)`; else episodes start standing."""

    def make_getup(num_envs: int = 4, recover: float = 0.0, fall: float = 0.0, **env):
        env = {"stateInit": "Default", **env}
        probabilities = {"recoveryEpisodeProb": recover, "fallInitProb": fall}
        return make_ase(num_envs, cls=HumanoidASEGetup, **probabilities, **env)

    return make_getup


def _heights(task: HumanoidASEGetup) -> torch.Tensor:
    return task.simulation.root_states[:, 2]


def _features(task: HumanoidASEGetup) -> torch.Tensor:
    """AMP features of the state, key bodies: hands and feet."""
    sim = task.simulation
    return compute_humanoid_observations(
        sim.root_states, sim.dof_pos, sim.dof_vel, sim.body_pos[:, [5, 8, 11, 14]], True, True
    )


def _state(task: HumanoidASEGetup) -> torch.Tensor:
    sim = task.simulation
    return torch.cat((sim.root_states, sim.dof_pos, sim.dof_vel), dim=-1).clone()


def _random_step(task: HumanoidASEGetup):
    return task.step(0.3 * torch.randn(task.num_envs, task.num_actions))


def _all_fell(task: HumanoidASEGetup) -> None:
    task.reset_buf.fill_(1)
    task.done_buf.fill_(Done.FAILED)


def _all_start_anew(task: HumanoidASEGetup) -> None:
    """Reset without anybody going on: the flags of falls are up before the first reset."""
    task.done_buf.zero_()
    task.reset()


# --- fallen states ----------------------------------------------------------------------------


def test_fallen_characters_lie_on_the_ground_at_rest(make, hold_pose) -> None:
    for armed in [False, True]:
        torch.manual_seed(0)
        task = make(8, fall=1.0, armed=armed, keyBodies=["right_hand", "left_hand"])
        task.reset_done()
        sim = task.simulation
        assert _heights(task).max() < LYING_M
        assert (sim.root_states[:, 7:] == 0.0).all()
        assert (sim.dof_vel == 0.0).all()
        # Bodies' origins are inside of their geoms, on or above the floor; it lies on some of them.
        lowest = sim.body_pos[..., 2].amin(dim=1)
        assert lowest.min() > -0.02
        assert lowest.max() < 0.15
        before = sim.root_states[:, :3].clone()
        actions = hold_pose(task)
        for _ in range(3):
            task.step(actions)
        # They neither fly nor fall, which is 5 cm in 0.1 s; the drives give way a little.
        assert (sim.root_states[:, :3] - before).norm(dim=-1).max() < 0.03


# --- starts of episodes -----------------------------------------------------------------------


def test_share_of_episodes_that_start_lying(make) -> None:
    for fall in [0.0, 0.3, 1.0]:
        torch.manual_seed(0)
        task = make(8, fall=fall)
        lying = 0.0
        for _ in range(30):
            task.reset_idx(torch.arange(8))
            down = _heights(task) < LYING_M
            assert torch.allclose(_heights(task)[~down], torch.tensor(NORMAL_HEIGHT_M))
            assert (task.recovery_steps_left == 60 * down).all()
            lying += float(down.float().mean()) / 30
        # of 240; standard deviation 0.030
        assert lying == pytest.approx(fall, abs=0.13 if 0.0 < fall < 1.0 else 1e-6)


def test_share_of_falls_after_which_the_character_goes_on(make) -> None:
    for recover in [0.0, 0.3, 1.0]:
        torch.manual_seed(0)
        task = make(8, recover=recover)
        going_on = 0.0
        for _ in range(30):
            task.reset()
            _random_step(task)  # away from the default pose
            _all_fell(task)
            before = _state(task)
            task.reset_done()
            same = (_state(task) == before).all(dim=-1)
            assert (task.recovery_steps_left == 60 * same).all()
            assert torch.allclose(_heights(task)[~same], torch.tensor(NORMAL_HEIGHT_M))
            for flags in (task.reset_buf, task.done_buf, task.progress_buf):
                assert (flags == 0).all()
            going_on += float(same.float().mean()) / 30
        assert going_on == pytest.approx(recover, abs=0.13 if 0.0 < recover < 1.0 else 1e-6)


def test_after_a_time_out_nobody_goes_on(make) -> None:
    task = make(4, recover=1.0, episodeLength=3)
    _all_start_anew(task)
    for _ in range(2):
        *_, dones, infos = _random_step(task)
    assert dones.tolist() == [1] * 4
    assert infos["terminate"].tolist() == [0] * 4
    task.reset_done()
    assert torch.allclose(_heights(task), torch.tensor(NORMAL_HEIGHT_M))


# --- time to get up ---------------------------------------------------------------------------


def test_lying_ends_no_episode_until_the_time_is_over(make, hold_pose) -> None:
    torch.manual_seed(0)
    task = make(4, fall=1.0, recoverySteps=4)
    _all_start_anew(task)
    ended, actions = [], hold_pose(task)
    for _ in range(4):
        *_, dones, infos = task.step(actions)
        assert torch.equal(dones, infos["terminate"])
        ended.append(dones.tolist())
    # The count is down to 0 after the fourth action.
    assert ended == [[0] * 4] * 3 + [[1] * 4]


# --- history ----------------------------------------------------------------------------------


def test_the_history_of_who_goes_on_is_continuous(make) -> None:
    torch.manual_seed(0)
    task = make(4, recover=1.0, numAMPObsSteps=3)
    _all_start_anew(task)
    _random_step(task)
    before = _random_step(task)[-1]["amp_obs"].view(4, 3, 125)
    task.done_buf[:2], task.reset_buf[:2] = Done.FAILED, 1
    task.reset_done()
    after = _random_step(task)[-1]["amp_obs"].view(4, 3, 125)
    torch.testing.assert_close(after[:, 1:], before[:, :2], rtol=0.0, atol=ATOL)
    assert not torch.equal(before[:2, 0], before[:2, 1])


def test_after_a_diverged_simulation_nobody_goes_on(make) -> None:
    task = make(3, recover=1.0, fall=0.0)
    _all_start_anew(task)
    _random_step(task)
    zeros = torch.zeros(1, 28)
    root = torch.tensor([[0.0, 0.0, 0.9, 0.0, 0.0, 0.0, 1.0, *[0.0] * 6]])
    task.simulation.write_state(torch.tensor([1]), root, zeros, zeros * float("nan"))
    *_, dones, infos = _random_step(task)
    assert dones.tolist() == infos["diverged"].long().tolist() == [0, 1, 0]
    assert not infos["terminate"].any()
    task.reset_done()
    # A new episode: the default pose, not the state that the simulation was put back to.
    assert float(_heights(task)[1]) == pytest.approx(NORMAL_HEIGHT_M)
    assert task.recovery_steps_left.tolist() == [0, 0, 0]
    start = _features(task)[1]
    history = _random_step(task)[-1]["amp_obs"].view(3, 10, 125)[1]
    torch.testing.assert_close(history[1:], start.expand(9, -1), rtol=0.0, atol=ATOL)


# --- reward -----------------------------------------------------------------------------------


def test_the_reward_is_how_far_the_character_is_up(make) -> None:
    torch.manual_seed(0)
    task = make(8, fall=1.0)
    task.reset_done()
    _, rewards, _, _ = task.step(torch.zeros(8, task.num_actions))
    head_m = task.simulation.body_pos[:, task.simulation.body_names.index("head"), 2]
    # Nobody who lies is higher than one who stands.
    up = (_heights(task) / NORMAL_HEIGHT_M + head_m / STANDING_HEAD_M) / 2
    torch.testing.assert_close(rewards, up, atol=ATOL, rtol=0)
    assert rewards.max() < LYING_M / NORMAL_HEIGHT_M
    standing = make(2, fall=0.0)
    _all_start_anew(standing)
    _, rewards, _, _ = standing.step(torch.zeros(2, standing.num_actions))
    assert rewards.min() > 0.95
