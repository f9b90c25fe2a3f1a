"""The warm start: the mean action follows the clips, then rests a while, in new runs alone."""

from __future__ import annotations

import logging

import pytest
import torch

from isaacgymenvs_lite.env_interface import TrackingDemo
from isaacgymenvs_lite.learning.warm_start import actor_parameters, clone_actions
from tests.tiny import CONFIG

WARM = (f"{CONFIG}.warm_start_steps=50", f"{CONFIG}.warm_start_frozen_epochs=2")


def values(parameters) -> torch.Tensor:
    return torch.cat([parameter.detach().flatten().clone() for parameter in parameters])


def test_the_actor_learns_the_actions_and_nothing_else_changes(make_agent):
    agent = make_agent()
    network = agent.model.a2c_network
    torch.manual_seed(0)
    obs = 3.0 + 2.0 * torch.randn(2000, agent.obs_shape[0])
    # Of one number: the networks of the tests are tiny.
    actions = 0.5 * torch.tanh(obs[:, :1] - 3.0).expand(-1, agent.actions_num)
    ours = {id(parameter) for parameter in actor_parameters(network)}
    others = [p for p in agent.model.parameters() if id(p) not in ours]
    before = values(others)
    normalizer = agent.model.running_mean_std
    demo = TrackingDemo(obs, actions, amp_obs=torch.empty(0))
    first = clone_actions(agent.model, normalizer, demo, num_steps=1, noise=0.1)
    assert clone_actions(agent.model, normalizer, demo, num_steps=400, noise=0.1) < 0.7 * first
    assert torch.equal(values(others), before)
    # Of 2000 rows, with noise: the variance grows by 1 %.
    torch.testing.assert_close(normalizer.running_mean.float(), obs.mean(dim=0), atol=0.02, rtol=0)
    assert normalizer.running_var.mean() == pytest.approx(4.0 * 1.01, rel=0.05)


def test_the_actor_rests_until_the_others_know_something(make_agent, caplog):
    caplog.set_level(logging.INFO)
    agent = make_agent(*WARM)
    agent.max_epochs = 3
    actor = actor_parameters(agent.model.a2c_network)
    critic = list(agent.model.a2c_network.critic_mlp.parameters())
    drawn = values(actor)
    seen = []
    train_epoch = agent.train_epoch

    def watched():
        seen.append((values(actor), values(critic)))
        result = train_epoch()
        seen.append((values(actor), values(critic)))
        return result

    agent.train_epoch = watched
    agent.train()
    assert "warm start: action error" in caplog.text
    assert not torch.equal(seen[0][0], drawn)
    for epoch, learns in enumerate((False, False, True)):
        (actor_before, critic_before), (actor_after, critic_after) = seen[2 * epoch : 2 * epoch + 2]
        assert torch.equal(actor_before, actor_after) != learns
        assert not torch.equal(critic_before, critic_after)


def test_a_checkpoint_is_not_taught_again(make_agent, tmp_path, caplog):
    first = make_agent(*WARM)
    first.max_epochs = 1
    first.train()
    first.save(str(tmp_path / "first"))
    caplog.set_level(logging.INFO)
    caplog.clear()
    second = make_agent(*WARM)
    second.restore(str(tmp_path / "first.pth"))
    second.max_epochs = 2
    second.train()
    assert "warm start" not in caplog.text


@pytest.mark.parametrize(
    "words", [("task.env.pdControl=False",), ("train.params.config.normalize_input=False",)]
)
def test_without_normalised_inputs_or_drives(make_agent, caplog, words):
    """Torques have no targets that lead; without a normaliser there is nothing to count in."""
    caplog.set_level(logging.INFO)
    agent = make_agent(*words, *WARM)
    agent.max_epochs = 1
    agent.train()
    assert ("no warm start" in caplog.text) == (words[0] == "task.env.pdControl=False")


ASE_WARM = ("task=HumanoidASE", "train=HumanoidASEPPO", *WARM, f"{CONFIG}.minibatch_size=16")


@pytest.mark.slow
def test_skills_are_taught_under_the_latents_of_the_clips(make_agent, caplog):
    caplog.set_level(logging.INFO)
    many = (f"{CONFIG}.amp_obs_demo_buffer_size=400", f"{CONFIG}.amp_minibatch_size=64")
    agent = make_agent(*ASE_WARM, *many, f"{CONFIG}.warm_start_steps=300", num_envs=64)
    network, task = agent.model.a2c_network, agent.vec_env.env
    others = [*network.critic_mlp.parameters(), *network.disc_parameters()]
    before = values(others)

    def agreements(pairs):
        found = agent.encoder.read(agent.discriminator.truncate(pairs))
        at, near = found.unbind(dim=1)
        return float((at * near).sum(-1).mean()), float((at * at.roll(1, dims=0)).sum(-1).mean())

    pairs = task.fetch_amp_obs_demo_pairs(256)
    assert agreements(pairs)[1] > 0.8  # a new encoder sees the same latent everywhere
    agent.init_tensors()
    agent.env_reset()
    assert "warm start: action error" in caplog.text
    assert torch.equal(values(others), before)
    of_near, of_others = agreements(pairs)
    assert of_others < 0.7
    assert of_others < of_near - 0.05
    demo = task.fetch_tracking_demo(500)
    latents = agent.encoder.read(agent.discriminator.truncate(demo.amp_obs))
    agent.model.eval()

    def error(actions):
        return float((actions - demo.actions).square().mean().detach()) ** 0.5

    obs = agent.model.norm_obs(demo.obs)
    own, wrong = (network.eval_actor(obs, z)[0] for z in (latents, latents.roll(250, dims=0)))
    assert error(own) < 0.7 * error(demo.actions.mean(dim=0))
    assert error(own) < 0.98 * error(wrong)


@pytest.mark.parametrize(
    "words",
    [
        tuple(f"{CONFIG}.enc_{loss}_coef=0" for loss in ("alignment", "uniformity", "command")),
        ("task.env.pdControl=False",),
    ],
)
def test_skills_without_an_encoder_of_clips_or_drives(make_agent, caplog, words):
    """No clip shows a latent that the encoder has not learned from clips."""
    caplog.set_level(logging.INFO)
    agent = make_agent(*ASE_WARM, *words)
    agent.max_epochs = 1
    agent.train()
    assert "no warm start" in caplog.text


def test_latents_command_only_with_the_goal_skill(make_agent):
    agent = make_agent(*ASE_WARM)
    agent.max_epochs = 1
    agent.train()
    scales = torch.tensor([0.2, 0.6, 0.3])
    commands = agent.vec_env.env.goal.commands * scales
    torch.testing.assert_close(commands, agent.schedule.latents[:, :3])
    assert "enc_command_loss" in agent.train_info_means()

    agent = make_agent(*ASE_WARM, "task.env.goal=none")
    agent.max_epochs = 1
    agent.train()
    assert "enc_command_loss" not in agent.train_info_means()
