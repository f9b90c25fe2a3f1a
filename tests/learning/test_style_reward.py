from __future__ import annotations

from pathlib import Path

import pytest
import torch

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import make_from_config
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.style_reward import StyleReward, read_style_params

SIZES = {
    "amp_obs_demo_buffer_size": 512,
    "amp_replay_buffer_size": 256,
    "amp_minibatch_size": 64,
    "disc_learning_rate": 1e-3,
}


@pytest.fixture
def task(walk_clip: Path):
    torch.manual_seed(0)
    words = [
        "task=HumanoidAMP",
        "num_envs=16",
        "num_threads=1",
        f"task.env.motion_file={walk_clip}",
    ]
    made = make_from_config(compose(words), sim_device="cpu", rl_device="cpu")
    made.reset()
    yield made
    made.close()


def test_the_weights_of_both_rewards_count(task):
    style = StyleReward(task, read_style_params(**SIZES, task_reward_w=0.5, disc_reward_w=2.0))
    *_, infos = task.step(task.zero_actions())
    amp_obs = infos["amp_obs"]
    expected = 0.5 * 3.0 + 2.0 * style.discriminator.reward(amp_obs).squeeze(-1)
    rewards = style.total(torch.full((16,), 3.0), amp_obs)
    assert torch.allclose(rewards, expected)


def test_it_learns_to_tell_falling_from_the_clips(task):
    style = StyleReward(task, read_style_params(**SIZES))
    told, rewards = [], []
    for _ in range(8):
        for _ in range(16):
            *_, infos = task.step(task.zero_actions())
            rewards.append(style.total(torch.zeros(16), infos["amp_obs"]).mean())
            task.reset_done()
        told.append(style.update(epochs=2))
    assert told[-1]["disc_agent_acc"] > 0.9
    assert told[-1]["disc_demo_acc"] > 0.9
    assert told[-1]["disc_loss"] < told[0]["disc_loss"]
    demos = task.fetch_amp_obs_demo(64)
    assert style.discriminator.reward(demos).mean() > 2.0 * torch.stack(rewards[-16:]).mean()


def test_an_update_without_motion_does_nothing(task):
    style = StyleReward(task, read_style_params(**SIZES))
    before = [parameter.clone() for parameter in style.network.parameters()]
    assert style.update() == {}
    assert all(map(torch.equal, before, style.network.parameters()))


def test_only_the_newest_steps_are_judged_where_the_key_says_so(task):
    style = StyleReward(task, read_style_params(**SIZES, amp_obs_steps=1))
    *_, infos = task.step(task.zero_actions())
    first = style.total(torch.zeros(16), infos["amp_obs"])
    infos["amp_obs"][:, 105:] = 7.0
    assert torch.equal(style.total(torch.zeros(16), infos["amp_obs"]), first)
    assert style.update()["disc_loss"] > 0.0


def test_a_task_without_clips_is_an_error():
    cfg = compose(["task=Cartpole", "num_envs=1", "num_threads=1"])
    cartpole = make_from_config(cfg, sim_device="cpu", rl_device="cpu")
    with pytest.raises(ConfigError, match="Cartpole has no amp_observation_space, fetch"):
        StyleReward(cartpole, read_style_params())
    cartpole.close()
