"""AMPAgent: rewards, demonstrations, replay, discriminator."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from rl_games.common.ivecenv import IVecEnv

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.wrappers.rl_games_env import RLGPUEnv
from tests.learning.conftest import make_training_set, model_inputs, prepared_minibatch

CONFIG = "train.params.config"
AMP_OBS_KINDS = ("amp_obs", "amp_obs_replay", "amp_obs_demo")


def start(agent: Any) -> Any:
    """What rl_games' `train()` does before its first epoch."""
    agent.init_tensors()
    agent.obs = agent.env_reset()
    agent.epoch_num = 1
    return agent


def snapshot(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in module.state_dict().items()}


def same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(first[name], second[name]) for name in first)


# --- rewards ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "kind"),
    [
        (("train.params.algo.name=amp_agent",), "least_squares"),
        (("train.params.algo.name=amp_continuous",), "logistic"),
        (("train.params.algo.name=amp",), "logistic"),
        (("train.params.algo.name=amp_agent", f"+{CONFIG}.disc_reward=logistic"), "logistic"),
        (
            ("train.params.algo.name=amp_continuous", f"+{CONFIG}.disc_reward=least_squares"),
            "least_squares",
        ),
    ],
    ids=["amp_agent", "amp_continuous", "amp", "key-logistic", "key-least_squares"],
)
def test_the_style_reward_of_each_algorithm(overrides, kind, make_agent, scramble):
    agent = make_agent(*overrides, f"{CONFIG}.disc_reward_scale=3.0")
    scramble(agent)
    with torch.no_grad():
        agent.model.a2c_network.get_parameter("_disc_logits.bias").fill_(0.7)
    amp_obs = torch.randn(4, 8, 210, generator=torch.Generator().manual_seed(0))
    before = snapshot(agent.discriminator.normalizer)
    rewards = agent.discriminator.reward(amp_obs)
    assert same(before, snapshot(agent.discriminator.normalizer))

    stats = agent.discriminator.normalizer
    normalized = (amp_obs.double() - stats.running_mean) / (stats.running_var + 1e-5).sqrt()
    with torch.no_grad():
        d = agent.model.a2c_network.eval_disc(normalized.clamp(-5, 5).float()).double()
    if kind == "logistic":
        expected = -torch.log((1 - torch.sigmoid(d)).clamp(min=1e-4)) * 3.0
    else:
        expected = (1 - 0.25 * (d - 1) ** 2).clamp(min=0) * 3.0
    assert rewards.shape == (4, 8, 1)
    assert expected.std() > 1e-3
    torch.testing.assert_close(rewards.double(), expected, rtol=1e-5, atol=1e-5)


def test_rewards_are_combined_by_weight(make_agent, record, roll_out):
    agent = make_agent(
        f"{CONFIG}.task_reward_w=0.3",
        f"{CONFIG}.disc_reward_w=0.7",
        f"{CONFIG}.reward_shaper.scale_value=2.0",
    )
    tape = record(agent)
    batch = roll_out(agent)
    style = agent.discriminator.reward(torch.stack(tape.amp_obs))
    expected = 0.3 * 2.0 * torch.stack(tape.rewards).unsqueeze(-1) + 0.7 * style
    torch.testing.assert_close(batch["rewards"].view(8, 4), expected[..., 0].T)
    # The advantages are made of them.
    buffer = agent.experience_buffer.tensor_dict
    last = (batch["returns"] - batch["values"]).view(8, 4)[:, -1]
    delta = expected[-1] + 0.99 * buffer["next_values"][-1] - buffer["values"][-1]
    torch.testing.assert_close(last, delta[:, 0], rtol=1e-5, atol=1e-5)


def test_the_style_has_another_weight_in_the_last_third(make_agent):
    weights = (f"{CONFIG}.disc_reward_w=0.5", f"{CONFIG}.disc_reward_w_final=1.5")
    agent = make_agent(*weights, "max_iterations=9")
    amp_rewards = {"disc_rewards": torch.tensor([2.0])}
    for agent.epoch_num, expected in ((6, 1.0), (7, 3.0)):
        rewards = agent._combine_rewards(torch.tensor([0.0]), amp_rewards)
        assert rewards.item() == pytest.approx(expected)


def test_amp_observations_are_stored_with_their_transition(make_agent, record, roll_out):
    agent = make_agent()
    tape = record(agent)
    batch = roll_out(agent)
    stored = agent.experience_buffer.tensor_dict["amp_obs"]
    assert torch.equal(stored, torch.stack(tape.amp_obs))
    assert batch["amp_obs"].shape == (32, 210)


def test_the_split_of_the_reward_is_logged(make_agent):
    agent = start(make_agent(f"{CONFIG}.task_reward_w=0.5", f"{CONFIG}.disc_reward_w=0.5"))
    agent.train_epoch()
    means = agent.train_info_means()
    # the task pays 1 per step
    assert means["task_reward_mean"] == pytest.approx(1.0)
    style = means["disc_reward_mean"]
    assert means["style_share"] == pytest.approx(style / (1.0 + style), rel=1e-5)
    assert means["disc_reward_std"] >= 0.0


# --- demonstrations and replay ----------------------------------------------------------------


def test_the_discriminator_may_see_the_newest_step_only(
    make_agent, make_runner, record, roll_out, tmp_path
):
    key = "+train.params.config.amp_obs_steps=1"
    agent = make_agent(key, "max_iterations=1")
    tape = record(agent)
    roll_out(agent)
    buffer = agent.experience_buffer.tensor_dict
    assert buffer["amp_obs"].shape == (4, 8, 105)
    assert torch.equal(buffer["amp_obs"][2], tape.amp_obs[2][:, :105])
    assert agent._amp_obs_demo_buffer.sample(3)["amp_obs"].shape == (3, 105)
    agent.train()
    agent.save(str(tmp_path / "agent"))
    player = make_runner(key).create_player()
    player.restore(str(tmp_path / "agent.pth"))
    amp_obs = torch.randn(6, 210)
    expected = agent.discriminator.reward(amp_obs[:, :105])
    torch.testing.assert_close(player.style_reward_function()(amp_obs), expected)


def test_demonstrations_fill_their_buffer_and_come_in_every_epoch(make_agent, monkeypatch):
    agent = make_agent()
    fetched = []
    fetch = agent.vec_env.env.fetch_amp_obs_demo
    monkeypatch.setattr(
        agent.vec_env.env, "fetch_amp_obs_demo", lambda n: fetched.append(n) or fetch(n)
    )
    before = snapshot(agent.discriminator.normalizer)
    start(agent)
    # 40 rows in fetches of 16
    assert fetched == [16, 16, 16]
    assert agent._amp_obs_demo_buffer.get_total_count() == 48
    assert same(before, snapshot(agent.discriminator.normalizer))
    agent.train_epoch()
    agent.train_epoch()
    assert fetched == [16] * 5
    assert agent._amp_obs_demo_buffer.get_total_count() == 48 + 32


def prepared(agent: Any) -> dict[str, torch.Tensor]:
    """The rows of one epoch's training set."""
    agent.set_eval()
    with torch.no_grad():
        batch = agent.play_steps()
    rows = make_training_set(agent, batch)
    end_epoch(agent, batch)
    return rows


def end_epoch(agent: Any, batch: dict[str, torch.Tensor]) -> None:
    agent._after_update(batch)


def rows_of(data: torch.Tensor) -> set[tuple[float, ...]]:
    return {tuple(row) for row in data.tolist()}


def test_the_training_set_has_as_many_demonstrations_and_replays_as_rows(make_agent):
    agent = start(make_agent())
    first = prepared(agent)
    for name in ("amp_obs", "amp_obs_replay", "amp_obs_demo", "obs"):
        assert len(first[name]) == 32, name
    # nothing to replay yet: the current observations
    assert torch.equal(first["amp_obs_replay"], first["amp_obs"])
    # 32 of the 40 rows in the buffer, none of them twice
    demos = rows_of(agent._amp_obs_demo_buffer.sample(40)["amp_obs"])
    assert rows_of(first["amp_obs_demo"]) <= demos
    assert len(rows_of(first["amp_obs_demo"])) == 32
    own = rows_of(first["amp_obs"])
    second = prepared(agent)
    # the replay buffer held the 32 rows of the first epoch, each drawn once or more
    assert rows_of(second["amp_obs_replay"]) <= own
    assert rows_of(second["amp_obs_replay"]).isdisjoint(rows_of(second["amp_obs"]))


def test_demonstrations_are_those_of_the_motion_library(make_agent, monkeypatch):
    agent = make_agent()
    monkeypatch.setattr(
        agent.vec_env.env, "fetch_amp_obs_demo", lambda n: torch.full((n, 210), 7.0)
    )
    rows = prepared(start(agent))
    assert (rows["amp_obs_demo"] == 7.0).all()
    assert not (rows["amp_obs"] == 7.0).any(dim=1).all()


def test_the_discriminator_sees_the_first_rows_of_a_minibatch(make_agent):
    agent = start(make_agent())
    rows = prepared(agent)
    minibatch = agent.dataset[0]
    assert {len(minibatch[n]) for n in ("amp_obs", "amp_obs_replay", "amp_obs_demo")} == {8}
    assert len(minibatch["obs"]) == 16
    index = [int((rows["obs"] == row).all(dim=1).nonzero()[0]) for row in minibatch["obs"][:8]]
    for name in ("amp_obs", "amp_obs_replay", "amp_obs_demo"):
        assert torch.equal(minibatch[name], rows[name][index])


def test_a_discriminator_minibatch_is_no_larger_than_the_minibatch(make_runner):
    runner = make_runner()
    runner.params["config"]["amp_minibatch_size"] = 1000
    agent = runner.algo_factory.create(runner.algo_name, base_name="run", params=runner.params)
    prepared(start(agent))
    assert len(agent.dataset[0]["amp_obs"]) == agent.minibatch_size == 16
    agent.writer.close()


def replay(agent: Any, count: int, offset: int = 0) -> None:
    """End an epoch of `count` rows whose numbers are offset, offset + 1, ..."""
    numbers = torch.arange(offset, offset + count, dtype=torch.float32)
    end_epoch(agent, {"amp_obs": numbers.view(-1, 1).expand(-1, 210)})


def test_all_rows_are_kept_until_the_replay_buffer_has_run_over(make_agent):
    agent = start(make_agent(f"{CONFIG}.amp_replay_keep_prob=0.0"))
    buffer = agent._amp_replay_buffer
    replay(agent, 32)
    replay(agent, 32)  # exactly full: 64 rows
    assert buffer.get_total_count() == 64
    replay(agent, 32)  # the total did not exceed the size yet
    assert buffer.get_total_count() == 96
    replay(agent, 32)  # now it does, and nothing is kept: an empty selection is legal
    assert buffer.get_total_count() == 96
    agent.train_epoch()
    assert buffer.get_total_count() == 96


def test_a_full_replay_buffer_takes_its_share(make_agent):
    agent = start(make_agent(f"{CONFIG}.amp_replay_keep_prob=0.25"))
    buffer = agent._amp_replay_buffer
    for _ in range(3):
        replay(agent, 32)
    torch.manual_seed(0)
    before, epochs = buffer.get_total_count(), 400
    for _ in range(epochs):
        replay(agent, 32)
    kept = (buffer.get_total_count() - before) / (32 * epochs)
    # standard error sqrt(.25 * .75 / 12800) = 0.004
    assert kept == pytest.approx(0.25, abs=0.02)


def test_of_more_rows_than_fit_a_random_subset_is_kept(make_agent):
    agent = start(make_agent(f"{CONFIG}.amp_replay_buffer_size=8"))
    replay(agent, 100)
    kept = agent._amp_replay_buffer.sample(8)["amp_obs"][:, 0].tolist()
    assert len(set(kept)) == 8
    # the last 8 or the first 8 by chance: 1 in 2e11
    assert set(kept) != set(range(92, 100))
    assert set(kept) != set(range(8))


# --- discriminator update ---------------------------------------------------------------------


def test_the_normaliser_counts_agent_replay_and_demonstration_before_any_is_normalised(make_agent):
    agent = make_agent()
    generator = torch.Generator().manual_seed(0)
    kinds = {
        name: scale * torch.randn(8, 210, generator=generator) + scale
        for name, scale in (("amp_obs", 1.0), ("amp_obs_replay", 3.0), ("amp_obs_demo", 9.0))
    }
    obs = 5.0 + torch.randn(16, 105, generator=generator)
    agent.set_train()
    agent.prepare_minibatch({**kinds, "obs": obs})
    mean, var, count = np.zeros(210), np.ones(210), 1.0
    for data in kinds.values():
        rows = data.double().numpy()
        delta, total = rows.mean(0) - mean, count + len(rows)
        var = (var * count + rows.var(0) * len(rows) + delta**2 * count * len(rows) / total) / total
        mean, count = mean + delta * len(rows) / total, total
    for data in kinds.values():
        expected = ((data.double().numpy() - mean) / np.sqrt(var + 1e-5)).clip(-5, 5)
        np.testing.assert_allclose(agent.discriminator.normalize(data), expected, atol=1e-4)
    assert agent.discriminator.normalizer.count.item() == 25.0
    # Slices of observations are normalised by several threads: they must not count again.
    assert agent.model.running_mean_std.count.item() == 17.0
    agent.model.norm_obs(obs)
    assert agent.model.running_mean_std.count.item() == 17.0


def test_the_losses_of_a_minibatch_are_those_of_the_discriminator(make_agent):
    agent = start(make_agent())
    prepared(agent)
    minibatch = agent.dataset[0]
    outputs = []
    handle = agent.model.register_forward_hook(lambda module, args, out: outputs.append(out))
    weights = [w.detach().clone() for w in agent.model.a2c_network.get_disc_weights()]
    agent.train_actor_critic(minibatch)
    handle.remove()
    result = {k: v.detach().double() for k, v in outputs[0].items() if v is not None}
    fakes = torch.cat((result["disc_agent_logit"], result["disc_agent_replay_logit"]))
    assert fakes.shape == (16, 1)
    prediction = 0.5 * (
        torch.log1p(fakes.exp()).mean() + torch.log1p((-result["disc_demo_logit"]).exp()).mean()
    )
    info = agent.train_info_means()
    penalty = info["disc_grad_penalty"]
    assert penalty > 0.0
    squares = [w.double().square().sum() for w in weights]
    loss = prediction + 0.05 * squares[-1] + 5 * penalty + 0.0001 * sum(squares)
    assert info["disc_loss"] == pytest.approx(loss.item(), rel=1e-5)
    assert info["disc_logit_loss"] == pytest.approx(squares[-1].item(), rel=1e-5)
    assert info["disc_agent_acc"] == (fakes < 0).double().mean().item()
    assert info["disc_agent_logit"] == pytest.approx(fakes.mean().item(), abs=1e-6)


def test_the_discriminator_learns_to_tell_apart(make_agent):
    """Against a policy that cannot move its limbs on purpose yet."""
    agent = start(make_agent(f"{CONFIG}.learning_rate=1e-3", num_envs=16))
    accuracies = []
    for _ in range(30):
        agent.train_epoch()
        means = agent.train_info_means()
        accuracies.append(0.5 * (means["disc_agent_acc"] + means["disc_demo_acc"]))
    assert np.mean(accuracies[-5:]) > 0.8


# --- what it needs of the task ----------------------------------------------------------------


class OwnVecEnv(IVecEnv):
    """Steps a task, whose other members agents do not see: `env` has AMP's members only."""

    def __init__(self, vec_env: Any, *members: str) -> None:
        self._vec_env = vec_env
        self.env = SimpleNamespace(**{name: getattr(vec_env.env, name) for name in members})

    def step(self, actions: torch.Tensor) -> Any:
        return self._vec_env.step(actions)

    def reset(self) -> Any:
        return self._vec_env.reset()

    def reset_done(self) -> Any:
        return self._vec_env.reset_done()

    def get_env_info(self) -> dict[str, Any]:
        return self._vec_env.get_env_info()


def made_with(vec_env: Any, runner: Any) -> Any:
    runner.params["config"] |= {"vec_env": vec_env, "env_info": vec_env.get_env_info()}
    return runner.algo_factory.create(runner.algo_name, base_name="run", params=runner.params)


def test_a_task_of_ones_own_needs_the_members_of_amp_only(make_runner):
    runner = make_runner("max_iterations=1")
    members = ("amp_observation_space", "fetch_amp_obs_demo")
    vec_env = OwnVecEnv(RLGPUEnv("rlgpu", 8), *members)
    agent = made_with(vec_env, runner)
    agent.train()
    agent.writer.close()
    assert agent.vec_env is vec_env
    assert agent.epoch_num == 1
    assert agent._amp_obs_demo_buffer.get_total_count() == 48 + 16


def test_a_task_without_reference_motions_is_refused(make_runner):
    runner = make_runner()
    with pytest.raises(ConfigError, match="SimpleNamespace has no fetch_amp_obs_demo") as caught:
        made_with(OwnVecEnv(RLGPUEnv("rlgpu", 8), "amp_observation_space"), runner)
    with pytest.raises(ConfigError, match="has no amp_observation_space, fetch_amp_obs_demo"):
        made_with(OwnVecEnv(RLGPUEnv("rlgpu", 8)), runner)
    assert "\n" not in str(caught.value)
    # a value of the key algo.name, if any: not the name of a Python class
    assert "'AMPAgent'" not in str(caught.value)


def test_the_discriminator_has_a_learning_rate_that_no_schedule_changes(make_agent, tmp_path):
    constant = f"{CONFIG}.lr_schedule=constant"
    agent = start(make_agent(f"{CONFIG}.disc_learning_rate=1e-4", constant))
    disc = {id(p) for p in agent.model.a2c_network.disc_parameters()}
    first, second = agent.optimizer.param_groups
    assert {id(p) for p in second["params"]} == disc
    assert {id(p) for p in first["params"]} == {id(p) for p in agent.model.parameters()} - disc
    agent.update_lr(1e-3)
    assert (first["lr"], second["lr"]) == (1e-3, 1e-4)
    agent.train_epoch()
    assert (first["lr"], second["lr"]) == (5e-5, 1e-4)  # the constant schedule's, and its own
    agent.save(str(tmp_path / "model"))
    # a resumed training has the rate of its own settings
    resumed = make_agent(f"{CONFIG}.disc_learning_rate=3e-4")
    resumed.restore(str(tmp_path / "model.pth"))
    assert resumed.optimizer.param_groups[1]["lr"] == 3e-4


def test_checkpoints_of_one_group_resume_with_a_learning_rate_for_the_discriminator(
    make_agent, tmp_path
):
    former = start(make_agent(f"{CONFIG}.disc_learning_rate=null"))
    assert len(former.optimizer.param_groups) == 1
    former.train_epoch()
    former.save(str(tmp_path / "model"))
    agent = make_agent(f"{CONFIG}.disc_learning_rate=1e-4")
    agent.restore(str(tmp_path / "model.pth"))
    for own, other in zip(agent.model.parameters(), former.model.parameters(), strict=True):
        if own.requires_grad:
            moments = (a.optimizer.state[p] for a, p in ((agent, own), (former, other)))
            assert same(*moments)


# --- noise on what the discriminator learns from ------------------------------------------------


def test_noise_is_drawn_for_what_the_discriminator_learns_from(make_agent, roll_out):
    agent = make_agent(f"+{CONFIG}.disc_input_noise=0.5")
    rows = prepared_minibatch(agent, roll_out)
    prepared = agent.prepare_minibatch(rows)
    noise = torch.stack([prepared[f"{kind}_noise"] for kind in AMP_OBS_KINDS])
    assert noise.shape == (3, 8, 210)
    # 5040 numbers: standard errors 0.007 and 0.005
    assert noise.mean().item() == pytest.approx(0.0, abs=0.035)
    assert noise.std().item() == pytest.approx(0.5, abs=0.025)
    with model_inputs(agent) as inputs:
        agent.compute_loss(prepared)
    for i, kind in enumerate(AMP_OBS_KINDS):
        assert torch.equal(inputs[0][f"{kind}_noise"], noise[i])
        assert torch.equal(inputs[0][kind], agent.discriminator.normalize(rows[kind]))
    # A reward is for the motion as it is.
    amp_obs = rows["amp_obs"]
    assert torch.equal(agent.discriminator.reward(amp_obs), agent.discriminator.reward(amp_obs))
