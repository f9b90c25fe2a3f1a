"""HRLAgent and its player over a low-level controller that was trained for an instant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from omegaconf import OmegaConf

from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.learning.skills.low_level_policy import latents_of_actions
from tests.learning.conftest import mean_actions
from tests.learning.test_gen_amp import CONFIG, GEN_AMP, LATENT_DIM

STEPS = 3


def save_train_file(agent: Any, file: Path) -> None:
    """Write the train file of an agent, without the sections of its configuration."""
    config = {
        key: value
        for key, value in agent.config.items()
        if isinstance(value, (bool, int, float, str)) or value is None
    }
    params = {"network": agent.network.network_builder.params, "config": config}
    OmegaConf.save(OmegaConf.create({"params": params}), file)


_trained: dict[tuple[str, ...], tuple[Any, bytes, bytes]] = {}


def train_low_level(
    make_agent: Callable[..., Any], folder: Path, *more: str
) -> tuple[Any, str, str]:
    """Return a GenAMP agent after two epochs, its train file and its checkpoint.

    A process trains it once; every test gets its own files.
    """
    file, checkpoint = folder / "llc.yaml", folder / "llc.pth"
    if more not in _trained:
        agent = make_agent(*GEN_AMP, "max_iterations=2", f"{CONFIG}.learning_rate=1e-3", *more)
        agent.train()
        agent.save(str(folder / "llc"))
        save_train_file(agent, file)
        _trained[more] = agent, file.read_bytes(), checkpoint.read_bytes()
    agent, *contents = _trained[more]
    for path, content in zip((file, checkpoint), contents, strict=True):
        path.write_bytes(content)
    return agent, str(file), str(checkpoint)


@pytest.fixture
def llc(make_agent: Callable[..., Any], tmp_path: Path) -> tuple[Any, str, str]:
    return train_low_level(make_agent, tmp_path)


def overrides(llc: tuple[Any, str, str], *more: str) -> tuple[str, ...]:
    return (
        "train.params.algo.name=hrl",
        "train.params.model.name=hrl",
        "train.params.network.name=hrl",
        "train.params.network.space.continuous.sigma_init.val=-1.0",
        f"+{CONFIG}.llc_config='{llc[1]}'",
        f"+{CONFIG}.llc_checkpoint='{llc[2]}'",
        f"+{CONFIG}.llc_steps={STEPS}",
        f"{CONFIG}.task_reward_w=0.9",
        f"{CONFIG}.disc_reward_w=0.1",
        *more,
    )


@pytest.fixture
def agent(llc, make_agent) -> Any:
    return make_agent(*overrides(llc))


@pytest.mark.parametrize(
    ("trained_in", "expected"), [("auto", True), (False, False), (None, False)]
)
def test_low_level_that_says_auto_computes_as_the_high_level(
    trained_in, expected, llc, make_agent, monkeypatch
):
    measured = "isaacgymenvs_lite.utils.precision.measure_bfloat16_speedup"
    monkeypatch.setattr(measured, lambda: pytest.fail("measured"))
    supports = "isaacgymenvs_lite.utils.precision.supports_bfloat16"
    monkeypatch.setattr(supports, lambda: True)
    file = Path(llc[1])
    train_file = OmegaConf.load(file)
    OmegaConf.update(train_file, "params.config.mixed_precision", trained_in)
    if trained_in is None:
        del train_file.params.config.mixed_precision
    OmegaConf.save(train_file, file)
    agent = make_agent(*overrides(llc, f"{CONFIG}.mixed_precision=True"))
    assert agent.llc.model.a2c_network.executor.bfloat16 is expected


def test_a_warm_start_teaches_the_latents_of_clips(llc, make_agent, monkeypatch):
    agent = make_agent(*overrides(llc, f"{CONFIG}.warm_start_steps=300"))
    demo = agent._env.fetch_tracking_demo(500)
    fetch = agent._env.fetch_tracking_demo
    wanted = agent.llc.encoder.read(agent.llc.discriminator.truncate(demo.amp_obs))

    def likeness() -> float:
        chosen = latents_of_actions(mean_actions(agent, demo.obs))
        return float((chosen * wanted).sum(-1).mean())

    before = likeness()
    agent._init_train()  # the task has no goal
    assert likeness() == before
    monkeypatch.setattr(
        agent._env, "fetch_tracking_demo", lambda n: replace(fetch(n), reaches_goal=True)
    )
    agent.env_reset()  # the first reset comes after the warm start
    assert likeness() > max(0.6, before + 0.3)
    assert agent.frozen_until > 0  # the critic learns first


def test_sizes_are_those_of_the_latent(agent, roll_out):
    batch = roll_out(agent)
    assert batch["actions"].shape == (32, LATENT_DIM)
    assert batch["mus"].abs().max() <= 1.0
    assert batch["played_frames"] == 32 * STEPS
    combined = 0.9 * batch["task_rewards"] + 0.1 * batch["disc_rewards"]
    torch.testing.assert_close(batch["rewards"], combined)
    assert batch["disc_rewards"].std() > 0.0
    assert agent.model.a2c_network.mu.out_features == LATENT_DIM


def test_the_low_level_acts_as_the_policy_that_was_trained(agent, llc):
    trained = llc[0]
    obs = 3.0 * torch.randn(8, 105, generator=torch.Generator().manual_seed(0))
    action = torch.randn(8, LATENT_DIM, generator=torch.Generator().manual_seed(1))
    latents = action / action.norm(dim=-1, keepdim=True)
    expected = mean_actions(trained, obs, latents)
    found = agent._compute_llc_action({"obs": obs}, action)
    torch.testing.assert_close(found, expected.clamp(-1, 1), rtol=1e-4, atol=1e-5)
    amp_obs = torch.randn(8, 210, generator=torch.Generator().manual_seed(2))
    expected = trained.discriminator.reward(amp_obs)
    torch.testing.assert_close(agent.llc.style_reward(amp_obs), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_exploration_may_last(correlation, llc, make_agent, roll_out):
    more = (f"+{CONFIG}.exploration_correlation={correlation}", f"{CONFIG}.horizon_length=32")
    agent = make_agent(*overrides(llc, *more))
    roll_out(agent)
    buffer = agent.experience_buffer.tensor_dict
    sigma = torch.tensor(-1.0).exp()
    noise = (buffer["actions"] - buffer["mus"]) / sigma
    # 31 * 8 * 6 products, few of them independent of each other
    assert (noise[1:] * noise[:-1]).mean().item() == pytest.approx(correlation, abs=0.3)
    normal = torch.distributions.Normal(buffer["mus"], sigma)
    expected = -normal.log_prob(buffer["actions"]).sum(dim=-1)
    torch.testing.assert_close(buffer["neglogpacs"], expected, rtol=1e-4, atol=1e-4)


class Env:
    """Stands in for the vec-env's step: what it returns is given, what it is asked is kept."""

    def __init__(self, agent: Any, dones: list[list[int]], terminate: list[list[int]]) -> None:
        self.asked: list[torch.Tensor] = []
        self._dones, self._terminate = torch.tensor(dones), torch.tensor(terminate)
        agent.vec_env.step = self.step
        self.amp_obs = torch.randn(len(dones), 8, 210, generator=torch.Generator().manual_seed(3))

    def step(self, actions: torch.Tensor) -> Any:
        n = len(self.asked)
        self.asked.append(actions.clone())
        obs = {"obs": torch.full((8, 105), float(n + 1))}
        rewards = torch.full((8,), 10.0**n)
        infos = {"terminate": self._terminate[n], "amp_obs": self.amp_obs[n], "step": n}
        return obs, rewards, self._dones[n], infos


def rows(*ones: int) -> list[int]:
    return [int(i in ones) for i in range(8)]


@pytest.fixture
def stepped(agent) -> Any:
    """The agent, its stand-in and a step: 1 falls first, 2 times out second, 3 falls last.

    Environment 2 falls too, after its end, and 1 reports no end any more.
    """
    agent.init_tensors()
    agent.obs = agent.env_reset()
    env = Env(
        agent,
        dones=[rows(1), rows(2), rows(2, 3)],
        terminate=[rows(1), rows(), rows(2, 3)],
    )
    actions = 2.0 * torch.randn(8, LATENT_DIM, generator=torch.Generator().manual_seed(4))
    return agent, env, agent.env_step(actions), actions


def test_rewards_are_averaged_and_end_with_the_episode(stepped):
    rewards = stepped[2][1]
    assert rewards.shape == (8, 1)
    expected = torch.full((8,), 111.0)
    expected[1], expected[2] = 1.0, 11.0
    torch.testing.assert_close(rewards[:, 0], expected / 3)


def test_an_end_is_an_end_and_a_fall_only_while_the_episode_lasts(stepped):
    agent, _, (_, _, dones, infos), _ = stepped
    assert dones.tolist() == rows(1, 2, 3)
    assert infos["terminate"].tolist() == rows(1, 3)
    assert infos["step"] == 2  # of the last step
    # whoever ended on the way starts again before the next step
    assert agent.vec_env.env.reset_buf[[1, 2, 3]].tolist() == [1, 1, 1]
    _, reset_ids = agent.vec_env.reset_done()
    assert {1, 2, 3} <= set(reset_ids.tolist())


def test_the_observation_is_that_of_the_end(stepped):
    obs = stepped[2][0]["obs"]
    assert obs[:, 0].tolist() == [3.0, 1.0, 2.0, 3.0, 3.0, 3.0, 3.0, 3.0]


def test_style_rewards_are_those_of_the_steps_that_counted(stepped):
    agent, env, _, _ = stepped
    style = torch.stack([agent.llc.style_reward(amp_obs) for amp_obs in env.amp_obs])
    style[1:, 1] = 0.0
    style[2:, 2] = 0.0
    torch.testing.assert_close(agent.style_rewards, style.sum(0) / 3)


def test_one_latent_for_all_steps_and_the_newest_observation(stepped):
    agent, env, _, actions = stepped
    latents = F.normalize(actions.clamp(-1, 1), dim=-1)
    for n in (1, 2):
        obs = torch.full((8, 105), float(n))
        expected = agent.llc.actions(obs, latents)
        playing = [0, 4, 5]
        torch.testing.assert_close(env.asked[n][playing], expected[playing])


def test_the_task_s_features_are_cut_off(llc, make_agent, monkeypatch):
    from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP as Task

    # The last five numbers of the character's are said to be a goal.
    monkeypatch.setattr(Task, "observation_groups", Task.character_observation_groups)
    monkeypatch.setattr(Task, "get_task_obs_size", lambda self: 5)
    with pytest.raises(CheckpointError, match="expects 111 dimensions of observation"):
        make_agent(*overrides(llc))


def test_the_low_level_never_changes(llc, make_agent):
    agent = make_agent(*overrides(llc, "max_iterations=3", f"{CONFIG}.learning_rate=1e-2"))
    model, normalizer = agent.llc.model, agent.llc.discriminator.normalizer
    before = {k: v.clone() for m in (model, normalizer) for k, v in m.state_dict().items()}
    own = {k: v.clone() for k, v in agent.model.state_dict().items()}
    agent.train()
    after = {k: v for m in (model, normalizer) for k, v in m.state_dict().items()}
    assert all(torch.equal(before[key], after[key]) for key in before)
    assert not model.training
    assert not any(p.requires_grad for p in model.parameters())
    moved = [not torch.equal(own[k], v) for k, v in agent.model.state_dict().items()]
    assert sum(moved) > 10
    assert agent.frame == 3 * 32 * STEPS


def test_a_checkpoint_holds_the_high_level_only_and_plays(llc, make_agent, make_runner, tmp_path):
    agent = make_agent(*overrides(llc, "max_iterations=2"))
    agent.train()
    agent.save(str(tmp_path / "high"))
    names = torch.load(tmp_path / "high.pth", weights_only=True)["model"]
    assert not [name for name in names if "disc" in name or "style" in name]
    player = make_runner(*overrides(llc)).create_player()
    player.restore(str(tmp_path / "high.pth"))
    env = player.env
    obs = {"obs": torch.randn(8, 105, generator=torch.Generator().manual_seed(0))}
    policy = agent.mean_policy(env)
    for _ in range(STEPS + 1):
        torch.testing.assert_close(player.act(obs), policy(obs), rtol=1e-4, atol=1e-5)
        obs = {"obs": obs["obs"].roll(1, 0)}
    player.run()
    assert player.result is not None
    # a reward of 1 for each control step
    assert player.result.reward == pytest.approx(player.result.steps)


@pytest.mark.slow
def test_a_checkpoint_knows_its_low_level(llc, make_agent, make_runner, tmp_path, caplog):
    agent = make_agent(*overrides(llc, "max_iterations=1"))
    agent.train()
    agent.save(str(tmp_path / "high"))
    high = f"checkpoint={tmp_path / 'high.pth'}"
    for left_out in ("null", "''"):
        given = overrides(llc, f"{CONFIG}.llc_checkpoint={left_out}", high)
        player = make_runner(*given, "test=True").create_player()
        player.restore(str(tmp_path / "high.pth"))
        assert player.llc.reference == agent.llc.reference
        assert make_agent(*given).llc.reference == agent.llc.reference
    assert "trained over" not in caplog.text

    state = torch.load(llc[2], weights_only=True)
    state["model"]["a2c_network.mu.bias"] += 1.0
    other = str(tmp_path / "other.pth")
    torch.save(state, other)
    given = overrides(llc, f"{CONFIG}.llc_checkpoint='{other}'", high)
    make_runner(*given, "test=True").create_player().restore(str(tmp_path / "high.pth"))
    assert f"{llc[2]}, whose weights are not those of {other}" in caplog.text


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (f"{CONFIG}.llc_steps=0", "llc_steps"),
        (f"{CONFIG}.llc_config=nowhere/none.yaml", "nowhere/none.yaml' does not exist"),
        (f"{CONFIG}.llc_config=HumanoidAMPPPO", "no skill policy"),
    ],
)
def test_keys_that_cannot_be_used(more, words, llc, make_agent):
    with pytest.raises(ConfigError, match=words):
        make_agent(*overrides(llc, more))


def test_checkpoints_that_cannot_be_used(llc, make_agent, tmp_path):
    for given, words in (("", "is not given"), (f"{tmp_path}/absent.pth", "no file")):
        with pytest.raises(CheckpointError, match=f"llc_checkpoint.*{words}.*task=HumanoidASE"):
            make_agent(*overrides(llc, f"{CONFIG}.llc_checkpoint='{given}'"))
    plain = make_agent()
    plain.init_tensors()
    plain.save(str(tmp_path / "amp"))
    with pytest.raises(CheckpointError, match="no low-level controller"):
        make_agent(*overrides(llc, f"{CONFIG}.llc_checkpoint='{tmp_path}/amp.pth'"))
