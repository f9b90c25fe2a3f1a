"""GenAMPAgent: latents through rollout and update, encoder, diversity, exploration mask."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.amp_continuous import exploration_probs
from isaacgymenvs_lite.paths import assets_dir
from tests.learning.conftest import (
    check_slices,
    make_training_set,
    mean_actions,
    model_inputs,
    prepared_minibatch,
)

CONFIG = "train.params.config"
LATENT_DIM = 6
GEN_AMP = (
    "train.params.algo.name=gen_amp",
    "train.params.model.name=continuous_gen_amp",
    "train.params.network.name=gen_amp",
    "+train.params.network.enc={units:[16,8],activation:relu,separate:False}",
    "+train.params.network.style={units:[12,8]}",
    f"+{CONFIG}.latent_dim={LATENT_DIM}",
    f"+{CONFIG}.latent_steps_min=1",
    f"+{CONFIG}.latent_steps_max=4",
    f"+{CONFIG}.amp_diversity_bonus=0.01",
    f"+{CONFIG}.amp_diversity_tar=1.0",
    f"+{CONFIG}.enc_coef=5",
    f"+{CONFIG}.enc_weight_decay=0",
    f"+{CONFIG}.enc_reward_scale=1",
    f"+{CONFIG}.enc_grad_penalty=0",
    f"+{CONFIG}.enc_reward_w=0.5",
    f"{CONFIG}.disc_reward_w=0.5",
)


@pytest.fixture
def make(make_agent: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *overrides, **kwargs: make_agent(*GEN_AMP, *overrides, **kwargs)


# --- rollout ----------------------------------------------------------------------------------


def test_the_policy_acts_under_the_latents_that_are_stored(make, roll_out, record):
    agent = make(f"{CONFIG}.horizon_length=8")
    record(agent, falls=((2, 3),))
    roll_out(agent)
    buffer = agent.experience_buffer.tensor_dict
    latents = buffer["amp_latents"]
    torch.testing.assert_close(latents.norm(dim=-1), torch.ones(8, 8))
    agent.model.eval()
    for n in range(8):
        obs = agent.model.norm_obs(buffer["obses"][n])
        mu, _ = agent.model.a2c_network.eval_actor(obs, latents[n])
        torch.testing.assert_close(buffer["mus"][n], mu, rtol=1e-5, atol=1e-6)
    changed = (latents[1:] != latents[:-1]).any(dim=-1)
    # kept for one to three steps
    assert 0.2 < changed.float().mean() < 0.95
    assert changed[2, 3]  # a new episode gets a new latent


def test_what_follows_is_valued_under_the_latent_of_the_step(make, roll_out, record):
    agent = make(f"{CONFIG}.horizon_length=8")
    tape = record(agent, falls=((2, 3), (5, 0)))
    roll_out(agent)
    buffer = agent.experience_buffer.tensor_dict
    agent.model.eval()
    for n in range(8):
        obs = agent.model.norm_obs(tape.after[n])
        value = agent.model.a2c_network.eval_critic(obs, buffer["amp_latents"][n])
        expected = agent.model.denorm_value(value) * (1 - tape.terminate[n]).unsqueeze(-1)
        torch.testing.assert_close(buffer["next_values"][n], expected, rtol=1e-4, atol=1e-5)


def test_rewards_are_the_sum_of_task_style_and_encoder(make, roll_out):
    agent = make(f"{CONFIG}.task_reward_w=0.25", f"{CONFIG}.enc_reward_scale=3")
    batch = roll_out(agent)
    found = agent.model.a2c_network.eval_enc(agent.discriminator.normalize(batch["amp_obs"]))
    cosine = (found * batch["amp_latents"]).sum(-1, keepdim=True)
    assert (cosine < 0).any()
    expected = 3 * torch.where(cosine > 0, cosine, torch.zeros(()))
    torch.testing.assert_close(batch["enc_rewards"], expected, rtol=1e-5, atol=1e-6)
    style = agent.discriminator.reward(batch["amp_obs"])
    torch.testing.assert_close(batch["disc_rewards"], style, rtol=1e-5, atol=1e-6)
    total = 0.25 * batch["task_rewards"] + 0.5 * style + 0.5 * expected
    torch.testing.assert_close(batch["rewards"], total, rtol=1e-5, atol=1e-5)


def test_another_task_is_played_under_latents_of_its_own(make, make_runner):
    agent = make()
    env = make_runner(num_envs=3).create_player().env
    policy = agent.mean_policy(env)
    env.reset()
    before = agent.schedule.latents.clone()
    actions = policy(env.reset_done()[0])
    assert actions.shape == (3, 28)
    assert torch.equal(agent.schedule.latents, before)


@pytest.mark.parametrize("share", [0, 1])
def test_a_player_draws_latents_as_the_training_did(share, make_runner):
    words = (*GEN_AMP, f"+{CONFIG}.clip_latents={share}", "task.env.motion_file=stand")
    player = make_runner(*words, num_envs=16).create_player()
    player.env.reset()
    player.act(player.env.reset_done()[0])
    windows = torch.cat(player.env.windows_of_clips())
    # The start of an episode is between two of the windows, which are 33 ms apart.
    distances = torch.cdist(player.current_latents, player.encoder.read(windows)).min(dim=1).values
    assert bool((distances < 0.05).all()) == bool(share)


@pytest.mark.parametrize("share", [0, 1])
def test_a_measured_policy_acts_under_latents_as_in_training(share, make, make_runner):
    agent = make(f"+{CONFIG}.clip_latents={share}", "task.env.motion_file=stand")
    env = make_runner("task.env.motion_file=stand", num_envs=16).create_player().env
    policy = agent.mean_policy(env)
    with model_inputs(agent) as inputs:
        policy(env.reset())
    latents = inputs[0]["amp_latents"]
    found = agent.encoder.read(torch.cat(env.windows_of_clips()))
    distances = torch.cdist(latents, found).min(dim=1).values
    assert bool((distances < 0.05).all()) == bool(share)


def test_episodes_start_under_the_latent_of_their_clip(make, roll_out, record):
    agent = make(f"+{CONFIG}.clip_latents=1", "task.env.stateInit=Random")
    record(agent, falls=((1, 3),))
    starts = []
    restart = agent.schedule.restart

    def spy(env_ids: torch.Tensor, latents: torch.Tensor | None = None) -> None:
        restart(env_ids, latents)
        if len(env_ids) == 0:
            return
        read = agent.encoder.read(agent.vec_env.env.amp_obs_of(env_ids))
        torch.testing.assert_close(agent.schedule.latents[env_ids], read, rtol=1e-5, atol=1e-6)
        starts.append(env_ids.tolist())

    agent.schedule.restart = spy
    roll_out(agent)
    assert starts == [list(range(8)), [3]]
    # Later latents are of clips, too.
    demos = agent.encoder.read(agent._amp_obs_demo_buffer.sample(40)["amp_obs"])
    agent.schedule.advance(torch.full((8,), 10_000))
    distances = torch.cdist(agent.schedule.latents, demos).min(dim=1).values
    assert distances.max() < 1e-3


def test_episodes_keep_to_their_clips_while_they_have_the_latent_of_their_start(make):
    agent = make(f"+{CONFIG}.clip_latents=0.5", "task.env.stateInit=Random", num_envs=32)
    task = agent.vec_env.env
    kept: set[int] = set()
    task.keep_to_clips = lambda env_ids: kept.update(env_ids.tolist())
    task.leave_clips = lambda env_ids: kept.difference_update(env_ids.tolist())
    agent.init_tensors()
    agent.obs = agent.env_reset()
    read = agent.encoder.read(task.amp_obs_of(torch.arange(32)))
    own = torch.isclose(agent.schedule.latents, read, atol=1e-5).all(dim=-1)
    assert 5 < own.sum() < 27
    assert kept == set(own.nonzero().flatten().tolist())
    before = agent.schedule.latents
    agent.schedule.change_at[:] = 9
    agent.schedule.change_at[::2] = 0
    agent.horizon_length = 1
    agent.set_eval()
    with torch.no_grad():
        agent.play_steps()
    changed = (agent.schedule.latents != before).any(dim=-1)
    assert changed.tolist() == [i % 2 == 0 for i in range(32)]
    assert kept == set((own & ~changed).nonzero().flatten().tolist())


# --- update -----------------------------------------------------------------------------------


def test_the_encoder_learns_from_pairs_of_the_clips(make, roll_out):
    agent = make(f"+{CONFIG}.enc_uniformity_coef=3", f"+{CONFIG}.enc_alignment_coef=2")
    rows = agent.prepare_minibatch(prepared_minibatch(agent, roll_out))
    demos = agent._amp_obs_demo_buffer.sample(2 * agent._amp_obs_demo_buffer.get_buffer_size())
    pairs = torch.stack((demos["amp_obs"], demos["amp_obs_near"]), dim=1)
    normalized = agent.discriminator.normalize(pairs.flatten(0, 1)).view(len(pairs), 2, -1)
    triples = rows["demo_triples"]
    assert triples.shape == (4, 3, 210)
    exact = "donot_use_mm_for_euclid_dist"
    found = (triples[:, :2].flatten(1), normalized.flatten(1))
    distances = torch.cdist(*found, compute_mode=exact)
    assert distances.min(dim=1).values.max() < 1e-3
    assert torch.equal(triples[:, 2], triples[:, 0].roll(1, dims=0))

    loss, values = agent.compute_loss(dict(rows))
    q = agent.model.a2c_network.eval_enc(triples.flatten(0, 1)).view(4, 3, -1)
    near, far = ((q[:, 0] * q[:, i]).sum(-1) for i in (1, 2))
    alignment = (2 - 2 * near).mean()  # |q - q'|^2 of unit vectors
    uniformity = torch.exp(-4 * (1 - far)).mean()
    assert values["enc_alignment_loss"].item() == pytest.approx(alignment.item(), rel=1e-4)
    assert values["enc_uniformity_loss"].item() == pytest.approx(uniformity.item(), rel=1e-4)
    total = weighted_sum(values) + 2 * alignment + 3 * uniformity
    assert loss.item() == pytest.approx(total.item(), rel=1e-5)


def weighted_sum(values: dict[str, torch.Tensor]) -> torch.Tensor:
    """The loss that the logged terms make with the weights of `GEN_AMP`."""
    weights = {
        **{"actor_loss": 1, "critic_loss": 5, "b_loss": 10},
        **{"disc_loss": 5, "enc_loss": 5, "amp_diversity_loss": 0.01},
    }
    return torch.stack([weight * values[name] for name, weight in weights.items()]).sum()


@pytest.mark.parametrize("penalty", [0.0, 0.3])
def test_the_losses_of_a_minibatch(penalty, make, roll_out):
    agent = make(f"{CONFIG}.enc_grad_penalty={penalty}", f"{CONFIG}.enc_weight_decay=0.01")
    rows = prepared_minibatch(agent, roll_out)
    assert len(rows["amp_latents"]) == 16
    assert torch.equal(rows["amp_obs_latents"], rows["amp_latents"][:8])
    rows = agent.prepare_minibatch(rows)
    network = agent.model.a2c_network
    loss, values = agent.compute_loss(dict(rows))

    amp_obs = agent.discriminator.normalize(rows["amp_obs"]).requires_grad_()
    error = -(network.eval_enc(amp_obs) * rows["amp_obs_latents"]).sum(-1)
    enc = error.mean() + 0.01 * sum(w.square().sum() for w in network.get_enc_weights())
    if penalty:
        (gradient,) = torch.autograd.grad(error.sum(), amp_obs, retain_graph=True)
        enc = enc + penalty * gradient.square().sum(-1).mean()
        assert values["enc_grad_penalty"] > 0
    assert values["enc_loss"].item() == pytest.approx(enc.item(), rel=1e-4)

    obs, other = agent.model.norm_obs(rows["obs"]), rows["diversity_latents"]
    torch.testing.assert_close(other.norm(dim=-1), torch.ones(16))
    mu, other_mu = (
        network.eval_actor(obs, z)[0].clamp(-1, 1).double() for z in (rows["amp_latents"], other)
    )
    latent_distance = 0.5 - 0.5 * (rows["amp_latents"] * other).sum(-1).double()
    quotient = (mu - other_mu).square().mean(-1) / (latent_distance + 1e-5)
    diversity = (1.0 - quotient).square().mean()
    assert values["amp_diversity_loss"].item() == pytest.approx(diversity.item(), rel=1e-4)

    assert loss.item() == pytest.approx(weighted_sum(values).item(), rel=1e-5)


def test_slices_give_the_gradients_of_the_whole(make, roll_out):
    rows = check_slices(make, roll_out, f"+{CONFIG}.enable_eps_greedy=True")
    assert rows["row_weights"].mean().item() == pytest.approx(1.0)


# --- exploration mask -------------------------------------------------------------------------


def test_exploration_probabilities():
    expected = [1.0, 0.999447, 0.993262, 0.917915, 0.0]
    assert exploration_probs(5).tolist() == pytest.approx(expected, abs=1e-6)
    assert exploration_probs(2).tolist() == [1.0, 0.0]
    assert exploration_probs(1).tolist() == [1.0]


def test_environments_that_do_not_explore_take_the_mean_action(make, roll_out, record):
    agent = make(f"+{CONFIG}.enable_eps_greedy=True", f"{CONFIG}.horizon_length=16")
    tape = record(agent)
    roll_out(agent)
    buffer = agent.experience_buffer.tensor_dict
    mask = buffer["rand_action_mask"]
    assert mask[:, 0].tolist() == [1.0] * 16
    assert mask[:, -1].tolist() == [0.0] * 16
    means, actions = buffer["mus"].clamp(-1, 1), torch.stack(tape.actions)
    is_mean = (actions == means).all(dim=-1)
    assert torch.equal(is_mean, mask == 0)


def test_who_did_not_explore_does_not_train_the_policy_but_the_critic(make, roll_out):
    agent = make(f"+{CONFIG}.enable_eps_greedy=True", f"{CONFIG}.entropy_coef=0.1")
    rows = prepared_minibatch(agent, roll_out)
    mask = rows["rand_action_mask"]
    assert 0 < mask.sum() < len(mask)
    rows = agent.prepare_minibatch(rows)
    _, values = agent.compute_loss(dict(rows))
    silent = (mask == 0).nonzero()[0]
    rows["advantages"] = rows["advantages"].clone()
    rows["returns"] = rows["returns"].clone()
    rows["advantages"][silent] += 100.0
    _, others = agent.compute_loss(dict(rows))
    for name in ("actor_loss", "actor_clip_frac", "b_loss", "entropy", "amp_diversity_loss"):
        assert torch.equal(values[name], others[name]), name
    rows["returns"][silent] += 100.0
    assert agent.compute_loss(dict(rows))[1]["critic_loss"] > 10 * values["critic_loss"]
    # means over the rows that explored
    result = agent.model(
        {
            "is_train": True,
            "obs": rows["obs"],
            "prev_actions": rows["actions"],
            "amp_latents": rows["amp_latents"],
        }
    )
    bound = agent.bound_loss(result["mus"])
    expected = (mask * bound).sum() / mask.sum()
    torch.testing.assert_close(values["b_loss"], expected)


def test_a_minibatch_in_which_nobody_explored(make, roll_out):
    agent = make(f"+{CONFIG}.enable_eps_greedy=True")
    rows = prepared_minibatch(agent, roll_out)
    rows["rand_action_mask"] = torch.zeros(16)
    agent.train_actor_critic(rows)
    assert all(p.isfinite().all() for p in agent.model.parameters())


def test_advantages_by_the_moments_of_those_that_explored(make, roll_out):
    agent = make(f"+{CONFIG}.enable_eps_greedy=True")
    batch = roll_out(agent)
    advantages = make_training_set(agent, batch)["advantages"]
    raw = (batch["returns"] - batch["values"])[:, 0].double().numpy()
    chosen = raw[batch["rand_action_mask"].numpy() == 1]
    expected = (raw - chosen.mean()) / (chosen.std(ddof=1) + 1e-8)
    np.testing.assert_allclose(advantages.numpy(), expected, rtol=1e-3, atol=1e-4)


# --- training, checkpoints, player ------------------------------------------------------------


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        (f"+{CONFIG}.enable_eps_greedy=True", f"{CONFIG}.enc_grad_penalty=0.1"),
        ("train.params.network.enc.separate=True",),
        (f"{CONFIG}.amp_diversity_bonus=0",),
        ("train.params.algo.name=ase", "train.params.model.name=ase"),
        (f"{CONFIG}.disc_learning_rate=null",),
    ],
    ids=["default", "mask", "separate", "no diversity", "ase", "one rate"],
)
def test_every_variant_trains(overrides, make):
    agent = make(*overrides, "max_iterations=2")
    before = {name: p.clone() for name, p in agent.model.named_parameters()}
    agent.train()
    after = dict(agent.model.named_parameters())
    assert all(p.isfinite().all() for p in after.values())
    for part in ("actor_mlp._style_mlp.0", "critic_mlp._mlp.0", "_disc_mlp.0", "_enc", "mu"):
        name = f"a2c_network.{part}.weight"
        assert not torch.equal(before[name], after[name]), name


def test_a_player_acts_as_the_agent_under_each_kind_of_latent(make, make_runner, tmp_path):
    agent = make("max_iterations=2", f"{CONFIG}.learning_rate=1e-3")
    agent.train()
    agent.save(str(tmp_path / "model"))
    rows = F.normalize(torch.randn(3, LATENT_DIM), dim=-1)
    np.save(tmp_path / "latents.npy", (2.0 * rows).numpy())  # scaled to length 1
    obs = torch.randn(8, 105, generator=torch.Generator().manual_seed(0))
    for latent in ("random", "interpolate", str(tmp_path / "latents.npy")):
        runner = make_runner(*GEN_AMP, f"+{CONFIG}.player={{latent:'{latent}',games_num:8}}")
        player = runner.create_player()
        player.restore(str(tmp_path / "model.pth"))
        player.run()
        assert player.result is not None
        assert player.result.num_episodes == 8
    action = player.get_action(obs, is_deterministic=True)
    under = rows[torch.arange(8) % 3]
    expected = mean_actions(agent, obs, under).clamp(-1, 1)
    torch.testing.assert_close(action, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.ones((3, 5)), r"shape \(3, 5\), expected \(K, 6\)"),
        (np.ones((0, 6)), r"shape \(0, 6\)"),
        (np.zeros((2, 6)), "a row is zero"),
        (np.full((2, 6), np.nan), "not finite"),
        (np.array(["a"] * 6), "expected random, interpolate or a .npy file"),
    ],
)
def test_latents_that_cannot_be_used(array, words, make_runner, tmp_path):
    np.save(tmp_path / "bad.npy", array)
    runner = make_runner(*GEN_AMP, f"+{CONFIG}.player={{latent:'{tmp_path}/bad.npy'}}")
    with pytest.raises(ConfigError, match=words):
        runner.create_player()


def test_a_latent_that_is_no_file(make_runner):
    runner = make_runner(*GEN_AMP, f"+{CONFIG}.player={{latent:randm}}")
    with pytest.raises(ConfigError, match=r"latent=randm: expected random, .* clips walk"):
        runner.create_player()


def test_latents_of_clips(make, make_runner, tmp_path):
    agent = make("max_iterations=1")
    agent.train()
    agent.save(str(tmp_path / "model"))
    for latent, clips in {"run": ["run"], "clips": ["walk", "run"]}.items():
        words = (*GEN_AMP, f"task.env.motion_file={two_clips(tmp_path)}", "num_envs=4")
        runner = make_runner(*words, f"+{CONFIG}.player={{latent:{latent},games_num:4}}")
        player = runner.create_player()
        player.restore(str(tmp_path / "model.pth"))
        player.run()
        windows = dict(zip(["walk", "run"], player.env.windows_of_clips(), strict=True))
        means = [player.encoder.read(windows[name]).mean(0) for name in clips]
        expected = F.normalize(torch.stack(means), dim=-1)[torch.arange(4) % len(clips)]
        torch.testing.assert_close(player.current_latents, expected)


def two_clips(folder) -> str:
    file = folder / "two.yaml"
    clips = assets_dir() / "amp/motions"
    rows = [f"- {{file: {clips / name}.npz, weight: 1}}" for name in ("walk", "run")]
    file.write_text("\n".join(["motions:", *rows]))
    return str(file)


def test_a_latent_for_a_policy_that_has_none(make_runner):
    runner = make_runner(f"+{CONFIG}.player={{latent:random}}")
    with pytest.raises(ConfigError, match="latent=random: this policy has no skill latents"):
        runner.create_player()


def test_keys_that_are_missing_or_wrong(make, make_agent):
    with pytest.raises(ConfigError, match="latent_steps_max"):
        make(f"{CONFIG}.latent_steps_min=4")
    without = [o for o in GEN_AMP if "latent_dim" not in o]
    with pytest.raises(ConfigError, match="latent_dim"):
        make_agent(*without)
