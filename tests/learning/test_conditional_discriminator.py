"""A discriminator that hears the latent: network, model, agent, player and low level."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F

from isaacgymenvs_lite.errors import ConfigError
from tests.learning.conftest import check_slices, make_training_set, prepared_minibatch
from tests.learning.test_gen_amp import GEN_AMP, LATENT_DIM
from tests.learning.test_gen_amp_models import training_input
from tests.learning.test_gen_amp_network_builder import build
from tests.learning.test_hrl import STEPS, Env, rows, train_low_level
from tests.learning.test_hrl import overrides as hrl_overrides

SIZES = (5, 3, 7, 4)  # observation, actions, AMP observation, latent
CONFIG = "train.params.config"
CONDITIONAL = (
    "+train.params.network.disc.conditional=True",
    "train.params.network.enc.separate=True",
)


@pytest.fixture
def make(make_agent: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *overrides, **kwargs: make_agent(*GEN_AMP, *CONDITIONAL, *overrides, **kwargs)


def network(**changes: Any) -> Any:
    return build({"disc.conditional": True, "enc.separate": True, **changes}, SIZES)


def unit(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return F.normalize(torch.randn(*shape, generator=generator), dim=-1)


def places(rows: torch.Tensor, among: torch.Tensor) -> torch.Tensor:
    """Where each of the rows stands among others."""
    same = (rows.unsqueeze(1) == among.unsqueeze(0)).all(dim=-1)
    assert same.any(dim=1).all()
    return same.int().argmax(dim=1)


def test_only_the_discriminator_is_wider():
    own, plain = network(), build({"enc.separate": True}, SIZES)
    assert own.disc_is_conditional and not plain.disc_is_conditional
    wider = {
        name
        for name, weights in own.state_dict().items()
        if weights.shape != plain.state_dict()[name].shape
    }
    assert wider == {"_disc_mlp.0.weight"}
    assert own.state_dict()["_disc_mlp.0.weight"].shape[1] == 7 + 4


def test_the_gradient_is_that_by_the_observation():
    own = network().double()
    amp_obs, latents = torch.ones(6, 7).double(), unit(6, 4).double()
    logits, gradient = own.eval_disc_with_gradient(amp_obs, latents)
    torch.testing.assert_close(logits, own.eval_disc(amp_obs, latents))
    assert (logits - own.eval_disc(amp_obs, unit(6, 4, seed=1).double())).abs().min() > 1e-6
    assert gradient.shape == (6, 7)
    step = torch.zeros(6, 7).double()
    step[:, 2] = 1e-6  # far from the kinks of the layers
    slope = (own.eval_disc(amp_obs + step, latents) - own.eval_disc(amp_obs - step, latents)) / 2e-6
    torch.testing.assert_close(gradient[:, 2], slope[:, 0], rtol=1e-4, atol=1e-6)


def test_it_shares_no_layers_with_the_encoder():
    with pytest.raises(ConfigError, match=r"disc.conditional=True.*set enc.separate=True"):
        network(**{"enc.separate": False})


def test_each_kind_of_rows_is_judged_under_its_own_latents(make):
    model = make().model.eval()
    own = model.a2c_network
    inputs: dict[str, Any] = {
        **training_input(),
        "obs": torch.zeros(6, 105),
        "prev_actions": torch.zeros(6, 28),
        "amp_latents": unit(6, LATENT_DIM),
    }
    kinds = {"amp_obs": "agent", "amp_obs_replay": "agent_replay", "amp_obs_demo": "demo"}
    for seed, kind in enumerate(kinds):
        inputs[kind] = torch.randn(4, 210, generator=torch.Generator().manual_seed(seed))
        inputs[f"{kind}_latents"] = unit(4, LATENT_DIM, seed=seed)
    result = model(inputs)
    for kind, name in kinds.items():
        expected = own.eval_disc(inputs[kind], inputs[f"{kind}_latents"])
        torch.testing.assert_close(result[f"disc_{name}_logit"], expected)


def test_demonstrations_stand_for_the_latent_of_another_moment(make, roll_out):
    agent = make()
    rows = prepared_minibatch(agent, roll_out)
    stored = all_demos(agent)
    place = places(rows["amp_obs_demo"], stored["amp_obs"])
    near = stored["amp_obs_near"][place]
    assert (near - rows["amp_obs_demo"]).abs().max() > 0.01
    torch.testing.assert_close(rows["amp_obs_demo_latents"], agent.encoder.read(near))


def test_the_replay_buffer_keeps_latents_with_their_motion(make, roll_out):
    agent = make(f"{CONFIG}.amp_replay_buffer_size=64")
    first = roll_out(agent)
    make_training_set(agent, first)
    # At first the rollout itself is replayed.
    assert torch.equal(first["amp_obs_replay_latents"], first["amp_latents"])
    agent._after_update(first)
    first = {name: first[name].clone() for name in ("amp_obs", "amp_latents")}
    agent.set_eval()
    with torch.no_grad():
        second = agent.play_steps()
    make_training_set(agent, second)
    place = places(second["amp_obs_replay"], first["amp_obs"])
    assert torch.equal(second["amp_obs_replay_latents"], first["amp_latents"][place])
    rows = agent.dataset[0]
    assert len(rows["amp_obs_replay_latents"]) == len(rows["amp_obs_replay"]) == 8


def test_the_style_reward_is_for_the_latent_of_the_step(make, roll_out):
    agent = make()
    batch = roll_out(agent)
    normalized = agent.discriminator.normalize(batch["amp_obs"])
    logits = agent.model.a2c_network.eval_disc(normalized, batch["amp_latents"])
    expected = agent.config["disc_reward_scale"] * F.softplus(logits)
    torch.testing.assert_close(batch["disc_rewards"], expected, rtol=1e-4, atol=1e-4)


def test_slices_give_the_gradients_of_the_whole(make, roll_out):
    check_slices(make, roll_out, f"+{CONFIG}.disc_input_noise=0.5")


@pytest.fixture
def low_level(make_agent, tmp_path) -> tuple[Any, str, str]:
    """As `test_hrl.llc`, conditional: the agent, its train file, its checkpoint."""
    return train_low_level(make_agent, tmp_path, *CONDITIONAL)


def test_a_hierarchy_is_paid_for_what_its_latents_stand_for(low_level, make_agent):
    trained = low_level[0]
    agent = make_agent(*hrl_overrides(low_level))
    agent.init_tensors()
    agent.obs = agent.env_reset()
    env = Env(agent, dones=[rows()] * STEPS, terminate=[rows()] * STEPS)
    actions = 2.0 * unit(8, LATENT_DIM, seed=4)
    agent.env_step(actions)
    latents = F.normalize(actions.clamp(-1, 1), dim=-1)
    expected = [trained.discriminator.reward(amp_obs, latents) for amp_obs in env.amp_obs]
    mean = torch.stack(expected).mean(dim=0)
    torch.testing.assert_close(agent.style_rewards, mean, rtol=1e-4, atol=1e-4)


def test_motion_without_latents_is_judged_as_what_it_looks_like(low_level, make_agent):
    trained = low_level[0]
    llc = make_agent(*hrl_overrides(low_level)).llc
    amp_obs = torch.randn(6, 210, generator=torch.Generator().manual_seed(2))
    expected = trained.discriminator.reward(amp_obs, trained.encoder.read(amp_obs))
    torch.testing.assert_close(llc.style_reward(amp_obs), expected, rtol=1e-4, atol=1e-4)
    others = llc.style_reward(amp_obs, unit(6, LATENT_DIM))
    assert (others - expected).abs().min() > 1e-6


def all_demos(agent: Any) -> dict[str, torch.Tensor]:
    return agent._amp_obs_demo_buffer.sample(2 * agent._amp_obs_demo_buffer.get_buffer_size())


def test_random_latents_go_with_moments_that_are_near(make, roll_out):
    sharp = (f"{CONFIG}.clip_latents=0.5", f"{CONFIG}.latent_sharpness=1e7")
    # As many rows of the rollout as demonstrations: all of them are drawn.
    sizes = (f"{CONFIG}.horizon_length=8", f"{CONFIG}.amp_obs_demo_buffer_size=64")
    agent = make(*(f"++{word}" for word in sharp), *sizes)
    batch = roll_out(agent)
    make_training_set(agent, batch)
    demos, latents = all_demos(agent), batch["amp_obs_demo_latents"]
    found = agent.encoder.read(demos["amp_obs_near"])
    taken = places(batch["amp_obs_demo"], demos["amp_obs"])
    of_clips = (latents - found[taken]).abs().amax(dim=-1) < 1e-6
    assert 0 < of_clips.sum() < 64
    # So sharp that every other one goes with a row whose latent is as near as any.
    nearness = latents[~of_clips] @ found.t()
    chosen = nearness.gather(1, taken[~of_clips].unsqueeze(1)).squeeze(1)
    torch.testing.assert_close(chosen, nearness.amax(dim=1), rtol=0, atol=1e-5)
    torch.testing.assert_close(latents.norm(dim=-1), torch.ones(64))


def test_without_it_all_rows_keep_their_own_latents(make, roll_out):
    agent = make(f"++{CONFIG}.clip_latents=0.5")
    batch = roll_out(agent)
    make_training_set(agent, batch)
    demos = all_demos(agent)
    near = demos["amp_obs_near"][places(batch["amp_obs_demo"], demos["amp_obs"])]
    torch.testing.assert_close(batch["amp_obs_demo_latents"], agent.encoder.read(near))


def test_a_good_motion_under_a_wrong_latent_is_a_fake(make, roll_out):
    agent = make(f"++{CONFIG}.disc_mismatched_demos=0.25")
    batch = roll_out(agent)
    make_training_set(agent, batch)
    num = len(batch["amp_obs"]) // 4
    fakes, latents = batch["amp_obs_replay"], batch["amp_obs_replay_latents"]
    assert torch.equal(fakes[:num], batch["amp_obs_demo"][:num])
    real = batch["amp_obs_demo_latents"]
    assert (latents[:num] - real[:num]).norm(dim=-1).min() > 0.01
    assert torch.equal(latents[1:num], real[: num - 1])  # of other demonstrations
    # The others are the policy's, under its own latents.
    assert torch.equal(fakes[num:], batch["amp_obs"][num:])
    assert torch.equal(latents[num:], batch["amp_latents"][num:])


def test_without_latents_there_are_no_wrong_ones(make):
    words = ("train.params.network.disc.conditional=False", f"++{CONFIG}.disc_mismatched_demos=0.5")
    with pytest.raises(ConfigError, match="disc_mismatched_demos: only a discriminator that"):
        make(*words)
