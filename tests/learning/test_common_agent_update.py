"""The update: losses, statistics, schedules, precision, with AMPAgent on real humanoids."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError
from tests.learning.conftest import make_training_set
from tests.tiny import ASYMMETRIC_CRITIC, TINY_STYLE


def counts(agent: Any) -> tuple[float, float, float]:
    return tuple(
        normalizer.count.item()
        for normalizer in (
            agent.model.running_mean_std,
            agent.model.value_mean_std,
            agent.discriminator.normalizer,
        )
    )


def start(agent: Any) -> Any:
    """What rl_games' `train()` does before its first epoch."""
    agent.init_tensors()
    agent.obs = agent.env_reset()
    agent.epoch_num = 1
    return agent


def test_statistics_move_in_every_minibatch_and_never_in_the_rollout(make_agent):
    agent = start(make_agent())
    assert counts(agent) == (1.0, 1.0, 1.0)
    agent.set_eval()
    with torch.no_grad():
        agent.play_steps()
    agent.get_action_values(agent.obs)
    assert counts(agent) == (1.0, 1.0, 1.0)
    agent.train_epoch()
    # B = 32 rows; observations: all of them in both mini-epochs; values: old ones and returns;
    # AMP observations: 3 kinds of 8 rows in 2 x 2 minibatches
    assert counts(agent) == (1.0 + 2 * 32, 1.0 + 2 * 32, 1.0 + 3 * 8 * 4)
    agent.train_epoch()
    assert counts(agent) == (1.0 + 4 * 32, 1.0 + 4 * 32, 1.0 + 3 * 8 * 8)


def test_one_epoch_changes_every_parameter_but_sigma(make_agent):
    agent = start(make_agent("train.params.config.task_reward_w=1.0"))
    before = {n: p.clone() for n, p in agent.model.named_parameters()}
    result = agent.train_epoch()
    for name, parameter in agent.model.named_parameters():
        moved = not torch.equal(parameter, before[name])
        assert moved == ("sigma" not in name), name
        assert parameter.isfinite().all()
    step_time, play_time, update_time, total_time, *losses, kls, last_lr, lr_mul = result
    assert 0 < step_time < play_time < total_time
    assert total_time == pytest.approx(play_time + update_time)
    # 2 mini-epochs of 2 minibatches: actor, critic, bounds, entropy and the KLs
    assert [len(x) for x in (*losses, kls)] == [4] * 5
    assert (last_lr, lr_mul) == (pytest.approx(1e-6 + (5e-5 - 1e-6) / 2), 1.0)  # of two epochs
    assert agent.curr_frames == 32


def test_the_environment_hears_how_far_the_training_is(make_agent):
    agent = start(make_agent())
    agent.frame = 1234
    agent.train_epoch()
    assert agent.vec_env.env.total_train_env_frames == 1234


def tap_losses(agent: Any) -> list[float]:
    """Return a list that the agent's total losses will be added to."""
    heard: list[float] = []
    whole = agent.compute_loss

    def tapped(rows: dict[str, torch.Tensor]) -> Any:
        loss, values = whole(rows)
        heard.append(loss.item())
        return loss, values

    agent.compute_loss = tapped
    return heard


def minibatch_of(agent: Any) -> dict[str, torch.Tensor]:
    """The first minibatch after a rollout of a fresh agent."""
    start(agent)
    agent.set_eval()
    with torch.no_grad():
        batch = agent.play_steps()
    make_training_set(agent, batch)
    return agent.dataset[0]


def test_total_loss_and_kl_against_the_formulas(make_agent):
    agent = make_agent(
        "train.params.config.entropy_coef=0.3", "train.params.config.clip_value=True"
    )
    minibatch = minibatch_of(agent)
    # policies further apart than one minibatch brings them, and means beyond the bounds
    with torch.no_grad():
        agent.model.a2c_network.mu.bias += torch.linspace(-1.3, 1.3, 28)
    minibatch["old_logp_actions"] = minibatch["old_logp_actions"] + 1.0
    minibatch["mu"] = minibatch["mu"] + 0.01
    minibatch["sigma"] = minibatch["sigma"] * 1.2
    heard = tap_losses(agent)
    outputs: list[dict[str, torch.Tensor]] = []
    handle = agent.model.register_forward_hook(lambda module, args, out: outputs.append(out))
    agent.train_actor_critic(minibatch)
    handle.remove()

    result = {k: v.detach().double().numpy() for k, v in outputs[0].items() if v is not None}
    given = {k: v.detach().double().numpy() for k, v in minibatch.items()}
    ratio = np.exp(given["old_logp_actions"] - result["prev_neglogp"])
    actor = np.maximum(
        -given["advantages"] * ratio, -given["advantages"] * np.clip(ratio, 0.8, 1.2)
    )
    near_old = given["old_values"] + np.clip(result["values"] - given["old_values"], -0.2, 0.2)
    critic = np.maximum(
        (given["returns"] - result["values"]) ** 2, (given["returns"] - near_old) ** 2
    )
    mu, sigma = result["mus"], result["sigmas"]
    bound = (np.maximum(mu - 1, 0) ** 2 + np.minimum(mu + 1, 0) ** 2).sum(-1)
    assert bound.mean() > 0.01
    disc = agent.train_log["disc_loss"][0].item()
    total = (
        actor.mean()
        + 5 * critic.mean()
        - 0.3 * result["entropy"].mean()
        + 10 * bound.mean()
        + 5 * disc
    )
    # float32 sums of 16 rows
    assert heard[0] == pytest.approx(total, rel=1e-4)
    info = {name: value[0].item() for name, value in agent.train_log.items()}
    assert info["actor_loss"] == pytest.approx(actor.mean(), rel=1e-4)
    assert info["critic_loss"] == pytest.approx(critic.mean(), rel=1e-4)
    assert info["b_loss"] == pytest.approx(bound.mean(), rel=1e-4)
    assert info["actor_clip_frac"] == pytest.approx((np.abs(ratio - 1) > 0.2).mean())

    old_mu, old_sigma = given["mu"], given["sigma"]
    kl = (
        np.log(old_sigma / sigma + 1e-5)
        + (sigma**2 + (old_mu - mu) ** 2) / (2 * (old_sigma**2 + 1e-5))
        - 0.5
    )
    values = {**agent.train_result}
    assert (values.pop("last_lr"), values.pop("lr_mul")) == (5e-5, 1.0)
    assert set(values) == {
        *("entropy", "kl", "b_loss", "actor_loss", "critic_loss", "actor_clip_frac"),
        *("disc_loss", "disc_grad_penalty", "disc_logit_loss", "disc_agent_acc"),
        *("disc_demo_acc", "disc_agent_logit", "disc_demo_logit"),
    }
    assert all(value.ndim == 0 and not value.requires_grad for value in values.values())
    assert agent.train_result["kl"].item() == pytest.approx(kl.sum(-1).mean(), rel=1e-4)


def test_advantages_and_values_of_the_training_set(make_agent, roll_out):
    agent = make_agent()
    batch = roll_out(agent)
    rows = make_training_set(agent, batch)
    raw = (batch["returns"] - batch["values"])[:, 0].double()
    expected = (raw - raw.mean()) / (raw.std(unbiased=True) + 1e-8)
    torch.testing.assert_close(rows["advantages"].double(), expected, rtol=1e-4, atol=1e-4)
    # old values first: their statistics, merged with one row (0, 1), normalise them
    values = batch["values"][:, 0].double().numpy()
    count = len(values) + 1
    mean = values.sum() / count
    var = (1 + values.var() * len(values) + values.mean() ** 2 * len(values) / count) / count
    np.testing.assert_allclose(
        rows["old_values"][:, 0].numpy(), (values - mean) / np.sqrt(var + 1e-5), atol=1e-4
    )
    assert not agent.value_mean_std.training


@pytest.mark.parametrize("kind", ["legacy", "standard", "standard_epoch"])
def test_learning_rate_schedules_hear_the_right_kls(kind, make_agent):
    agent = start(
        make_agent(
            "train.params.config.lr_schedule=adaptive",
            f"+train.params.config.schedule_type={kind}",
            "train.params.config.mini_epochs=3",
        )
    )
    heard: list[float] = []
    rates = iter(1e-3 * (1 + n) for n in range(100))

    class Scheduler:
        def update(self, lr: float, entropy_coef: float, epoch: int, frames: int, kl: float) -> Any:
            heard.append(kl)
            return next(rates), entropy_coef

    agent.scheduler = Scheduler()
    calc_gradients, kls, rates_used = agent.calc_gradients, [], []

    def tapped(minibatch: Any) -> None:
        rates_used.append(agent.optimizer.param_groups[0]["lr"])
        calc_gradients(minibatch)
        kls.append(agent.train_result["kl"].item())

    agent.calc_gradients = tapped
    result = agent.train_epoch()
    assert len(kls) == 6
    if kind == "legacy":
        expected, used = kls, [5e-5, 1e-3, 2e-3, 3e-3, 4e-3, 5e-3]
    elif kind == "standard":  # the mean over all so far in this epoch
        expected = [np.mean(kls[:2]), np.mean(kls[:4]), np.mean(kls)]
        used = [5e-5, 5e-5, 1e-3, 1e-3, 2e-3, 2e-3]
    else:
        expected, used = [np.mean(kls)], [5e-5] * 6
    assert heard == pytest.approx(expected, rel=1e-5)
    assert rates_used == pytest.approx(used)
    last = 1e-3 * len(expected)
    assert agent.optimizer.param_groups[0]["lr"] == result[-2] == agent.last_lr
    assert agent.last_lr == pytest.approx(last)


def test_the_adaptive_schedule_moves_the_rate(make_agent):
    agent = start(
        make_agent(
            "train.params.config.lr_schedule=adaptive", "train.params.config.kl_threshold=1e9"
        )
    )
    agent.train_epoch()
    # every KL is below half the threshold: four minibatches, each times 1.5
    assert agent.optimizer.param_groups[0]["lr"] == pytest.approx(5e-5 * 1.5**4)


def test_truncated_gradients(make_agent):
    agent = make_agent(
        "train.params.config.truncate_grads=True", "train.params.config.grad_norm=0.01"
    )
    agent.train_actor_critic(minibatch_of(agent))
    gradients = [p.grad.flatten() for p in agent.model.parameters() if p.grad is not None]
    # clip_grad_norm_ divides by norm + 1e-6
    assert torch.cat(gradients).norm().item() == pytest.approx(0.01, rel=1e-3)


@pytest.mark.parametrize(
    "overrides",
    [
        ("train.params.config.bounds_loss_coef=null",),
        ("train.params.config.ppo=False",),
        ("train.params.config.bounds_loss_coef=null", "train.params.config.ppo=False"),
        ("train.params.config.normalize_value=False", "train.params.config.normalize_input=False"),
        ("train.params.config.normalize_amp_input=False",),
        ("train.params.network.separate=False",),
        ("train.params.config.normalize_advantage=False",),
        ("+train.params.config.use_diagnostics=True",),
        ("train.params.config.disc_loss=least_squares", "train.params.config.disc_weight_decay=0"),
    ],
    ids=lambda overrides: ",".join(x.rsplit(".", 1)[-1] for x in overrides),
)
def test_every_variant_trains(overrides, make_agent):
    agent = make_agent(*overrides)
    agent.train()
    assert agent.epoch_num == 2
    for name, parameter in agent.model.named_parameters():
        assert parameter.isfinite().all(), name


@pytest.mark.parametrize("num_envs", [1, 3])
def test_few_environments_train(num_envs, make_agent):
    agent = make_agent(num_envs=num_envs)
    agent.train()
    assert all(p.isfinite().all() for p in agent.model.parameters())
    assert agent.minibatch_size == 4 * num_envs


def test_without_bound_loss_none_is_counted(make_agent):
    agent = make_agent("train.params.config.bounds_loss_coef=null")
    minibatch = minibatch_of(agent)
    with torch.no_grad():
        agent.model.a2c_network.mu.bias += 3.0
    heard = tap_losses(agent)
    agent.train_actor_critic(minibatch)
    info = {name: value[0].item() for name, value in agent.train_log.items()}
    expected = info["actor_loss"] + 5 * info["critic_loss"] + 5 * info["disc_loss"]
    assert heard[0] == pytest.approx(expected, rel=1e-5)


def test_a_key_that_this_family_does_not_support_is_named(make_agent):
    with pytest.raises(ConfigError, match=r"config\.self_play_config is not supported"):
        make_agent("+train.params.config.self_play_config={minibatch_size:16}")


def test_a_critic_of_latents_cannot_be_asymmetric(make_agent):
    words = ("task=HumanoidASE", *TINY_STYLE)
    with pytest.raises(ConfigError, match=r"config\.central_value_config is not supported"):
        make_agent(*words, f"+train.params.config.central_value_config={ASYMMETRIC_CRITIC}")


# --- mixed precision --------------------------------------------------------------------------

WIDER = ("train.params.network.mlp.units=[64,32]", "train.params.network.disc.units=[64,32]")


@pytest.mark.usefixtures("bfloat16")
def test_bfloat16_changes_the_losses_only_slightly(make_agent):
    exact = make_agent(*WIDER)
    minibatch = minibatch_of(exact)
    rough = make_agent(*WIDER, "train.params.config.mixed_precision=True")
    rough.set_full_state_weights(exact.get_full_state_weights())
    dtypes = []
    layer = rough.model.a2c_network.mu
    layer.register_forward_hook(lambda module, args, out: dtypes.append(out.dtype))
    infos = []
    for agent in (exact, rough):
        agent.train_log.clear()
        agent.train_actor_critic({k: v.clone() for k, v in minibatch.items()})
        infos.append(agent.train_info_means())
    assert dtypes == [torch.bfloat16]
    assert set(infos[0]) == set(infos[1])
    for name in ("critic_loss", "entropy", "disc_loss", "disc_grad_penalty", "disc_logit_loss"):
        # bfloat16 has eight bits: 0.4% per operation
        assert infos[1][name] == pytest.approx(infos[0][name], rel=0.05), name
        assert infos[1][name] != infos[0][name] or name in ("entropy", "disc_logit_loss")
    assert infos[1]["actor_loss"] == pytest.approx(infos[0]["actor_loss"], abs=0.1)
    # weights, statistics and the optimiser stay in full precision
    assert {p.dtype for p in rough.model.parameters()} == {torch.float32}
    assert rough.model.running_mean_std.running_mean.dtype == torch.float64


@pytest.mark.usefixtures("bfloat16")
def test_bfloat16_trains(make_agent):
    agent = make_agent(*WIDER, "train.params.config.mixed_precision=True")
    agent.train()
    assert all(p.isfinite().all() for p in agent.model.parameters())
    assert agent.experience_buffer.tensor_dict["mus"].dtype == torch.float32


@pytest.mark.parametrize(("speedup", "chosen"), [(5.0, torch.bfloat16), (0.5, torch.float32)])
def test_auto_follows_the_measurement(speedup, chosen, make_agent, monkeypatch):
    module = "isaacgymenvs_lite.utils.precision.measure_bfloat16_speedup"
    monkeypatch.setattr(module, lambda: speedup)
    agent = make_agent("train.params.config.mixed_precision=auto")
    dtypes = []
    layer = agent.model.a2c_network.mu
    layer.register_forward_hook(lambda module, args, out: dtypes.append(out.dtype))
    result = agent.get_action_values({"obs": torch.zeros(2, 105)})
    assert dtypes == [chosen]
    assert result["mus"].dtype == torch.float32
