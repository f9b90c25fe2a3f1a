"""Subclasses of the agents, players and networks, as people wrote them for the published ones."""

from __future__ import annotations

import importlib
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import OverrideError
from isaacgymenvs_lite.learning.amp_continuous import AMPAgent
from isaacgymenvs_lite.learning.amp_datasets import AMPDataset
from isaacgymenvs_lite.learning.amp_network_builder import AMPBuilder
from isaacgymenvs_lite.learning.amp_players import AMPPlayerContinuous
from isaacgymenvs_lite.learning.common_agent import CommonAgent
from isaacgymenvs_lite.learning.gen_amp import GenAMPAgent
from isaacgymenvs_lite.learning.gen_amp_players import GenAMPPlayerContinuous
from isaacgymenvs_lite.learning.hrl_continuous import HRLAgent
from isaacgymenvs_lite.learning.hrl_players import HRLPlayer
from isaacgymenvs_lite.learning.published_names import PublishedNames
from isaacgymenvs_lite.learning.replay_buffer import ReplayBuffer
from tests.learning.published_surface import MISSING, SAME
from tests.learning.test_gen_amp import CONFIG, GEN_AMP
from tests.learning.test_hrl import llc, overrides  # noqa: F401  a fixture

GEN = (*GEN_AMP, f"{CONFIG}.enc_grad_penalty=0.1")


def class_of(ours: str) -> Any:
    module, *names = ours.split(".")
    found: Any = importlib.import_module(f"isaacgymenvs_lite.learning.{module}")
    for name in names:
        found = getattr(found, name)
    return found


def same_names(cls: type) -> set[str]:
    return {name for ours in SAME if class_of(ours) in cls.__mro__ for name in SAME[ours].split()}


def same_methods(cls: type) -> set[str]:
    return {name.removesuffix("()") for name in same_names(cls) if name.endswith("()")}


def same_attributes(cls: type) -> set[str]:
    return {name for name in same_names(cls) if not name.endswith("()")}


def counting(cls: type) -> tuple[Any, Counter[str]]:
    """Return a subclass that overrides every published method, and how often each is called."""
    calls: Counter[str] = Counter()

    def override(name: str) -> Callable[..., Any]:
        def method(self: Any, *args: Any, **kwargs: Any) -> Any:
            calls[name] += 1
            return getattr(super(mine, self), name)(*args, **kwargs)

        return method

    mine: Any = type("Mine", (cls,), {name: override(name) for name in same_methods(cls)})
    return mine, calls


@pytest.fixture
def make_own(make_runner) -> Callable[..., Any]:
    """Return make(cls, *overrides), an agent of a class of the caller's own."""

    def make(cls: Any, *more: str, **kwargs: Any) -> Any:
        runner = make_runner(*more, **kwargs)
        return cls(base_name="run", params=runner.params)

    return make


def test_what_is_the_same_is_there():
    for ours, names in SAME.items():
        for name in names.split():
            found: Any = class_of(ours)
            for part in name.removesuffix("()").split(".") if name.endswith("()") else ():
                found = getattr(found, part)
            assert callable(found), name


# --- what is the same is called -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("cls", "more"),
    [(AMPAgent, (f"+{CONFIG}.enable_eps_greedy=True",)), (GenAMPAgent, GEN), (HRLAgent, ())],
)
def test_every_override_of_an_agent_is_called(cls, more, make_own, request, tmp_path):
    if cls is HRLAgent:
        more = overrides(request.getfixturevalue("llc"))
    mine, calls = counting(cls)
    agent = make_own(mine, *more)
    agent.train()
    assert (Path(agent.nn_dir) / f"{agent.config['name']}.pth").parent.is_dir()
    agent.save(str(tmp_path / "mine"))
    agent.restore(str(tmp_path / "mine.pth"))
    agent.writer.close()
    assert same_methods(cls) - set(calls) == set()


@pytest.mark.parametrize(
    ("cls", "more"), [(AMPPlayerContinuous, ()), (GenAMPPlayerContinuous, GEN), (HRLPlayer, ())]
)
def test_every_override_of_a_player_is_called(cls, more, make_runner, request, tmp_path):
    if cls is HRLPlayer:
        more = overrides(request.getfixturevalue("llc"))
    runner = make_runner(
        *more, "task.env.episodeLength=4", f"+{CONFIG}.print_disc_prediction=True", num_envs=2
    )
    agent = runner.algo_factory.create(runner.algo_name, base_name="run", params=runner.params)
    agent.save(str(tmp_path / "agent"))
    agent.writer.close()
    mine, calls = counting(cls)
    player = mine(runner.params)
    player.restore(str(tmp_path / "agent.pth"))
    player.games_num = 2
    player.run()
    assert player.result.num_episodes == 2
    assert same_methods(cls) - set(calls) == set()
    for name in same_attributes(cls):
        getattr(player, name)


def test_every_override_of_the_buffers_is_called():
    buffer_cls, calls = counting(ReplayBuffer)
    buffer = buffer_cls(4, "cpu")
    buffer.store({"x": torch.arange(3.0)})
    buffer.store_some({"x": torch.arange(3.0)}, 1.0)
    buffer.sample(4)
    assert {"store", "sample", "reset", "_reset_sample_idx", "_init_data_buf"} <= set(calls)
    assert calls["_init_data_buf"] == 1
    dataset_cls, calls = counting(AMPDataset)
    dataset = dataset_cls(4, 2, False, False, "cpu", 1)
    dataset.update_values_dict({"x": torch.arange(4.0)})
    assert sorted(torch.cat([dataset[i]["x"] for i in range(2)]).tolist()) == [0.0, 1.0, 2.0, 3.0]
    assert (calls["_get_item"], calls["_shuffle_idx_buf"]) == (2, 1)
    for built in (buffer, dataset):
        assert all(hasattr(built, name) for name in same_attributes(type(built)))


def test_buffers_of_ones_own_are_filled_and_sampled(make_own):
    class Mine(AMPAgent):
        def _build_amp_buffers(self) -> None:
            super()._build_amp_buffers()
            self._amp_obs_demo_buffer = ReplayBuffer(40, "cpu")
            self._amp_replay_buffer = ReplayBuffer(50, "cpu")

    agent = make_own(Mine)
    agent.train()
    agent.writer.close()
    for buffer, size in ((agent._amp_obs_demo_buffer, 40), (agent._amp_replay_buffer, 50)):
        assert buffer.get_buffer_size() == size
        assert buffer.get_total_count() > 0


def test_a_network_s_own_actor_and_critic_count_everywhere(make_agent):
    network = make_agent().model.a2c_network.serial
    obs = torch.randn(6, 105)
    plain = network.forward({"obs": obs})

    class Own(AMPBuilder.Network):
        def eval_critic(self, obs: Tensor) -> Tensor:
            return super().eval_critic(obs) + 1.0

        def eval_actor(self, obs: Tensor) -> tuple[Tensor, Tensor]:
            mu, sigma = super().eval_actor(obs)
            return mu + 2.0, sigma

    network.__class__ = Own
    mu, sigma, value, state = network.forward({"obs": obs})
    torch.testing.assert_close(mu, plain[0] + 2.0)
    torch.testing.assert_close(sigma, plain[1])
    torch.testing.assert_close(value, plain[2] + 1.0)
    assert state is None


# --- what an override changes -------------------------------------------------------------------


def test_a_reward_of_ones_own_is_learned_from(make_own, roll_out):
    class Mine(AMPAgent):
        def _calc_disc_rewards(self, amp_obs: Tensor) -> Tensor:  # type: ignore[override]
            return torch.full_like(amp_obs[..., :1], 3.0)

    agent = make_own(Mine, f"{CONFIG}.task_reward_w=0.5", f"{CONFIG}.disc_reward_w=2.0")
    batch = roll_out(agent)
    assert (batch["disc_rewards"] == 3.0).all()
    torch.testing.assert_close(batch["rewards"], 0.5 * batch["task_rewards"] + 6.0)
    assert batch["rewards"].shape == (32, 1)


def test_the_published_loss_of_the_discriminator_gives_the_same_update(make_own):
    class Published(AMPAgent):
        def _disc_loss(  # type: ignore[override]
            self, disc_agent_logit: Tensor, disc_demo_logit: Tensor, obs_demo: Tensor
        ) -> dict[str, Tensor]:
            (gradient,) = torch.autograd.grad(
                disc_demo_logit,
                obs_demo,
                grad_outputs=torch.ones_like(disc_demo_logit),
                create_graph=True,
            )
            info = super()._disc_loss(disc_agent_logit, disc_demo_logit, obs_demo)
            torch.testing.assert_close(
                info["disc_grad_penalty"], gradient.square().sum(dim=-1).mean().detach()
            )
            return info

    trained = []
    for cls in (AMPAgent, Published):
        torch.manual_seed(3)
        agent = make_own(cls, f"+{CONFIG}.disc_input_noise=0.1")
        agent.train()
        agent.writer.close()
        trained.append(agent.model.state_dict())
    for name, value in trained[0].items():
        torch.testing.assert_close(trained[1][name], value, rtol=1e-5, atol=1e-6)


def test_parts_of_the_discriminator_s_loss(make_own, roll_out):
    class Mine(AMPAgent):
        def _disc_loss_neg(self, disc_logits: Tensor) -> Tensor:
            return 0.0 * disc_logits.mean() + 100.0

        def _compute_disc_acc(self, *logits: Tensor) -> tuple[Tensor, Tensor]:
            return torch.tensor(0.25), torch.tensor(0.75)

    agent = make_own(Mine)
    agent.train()
    agent.writer.close()
    means = agent.train_info_means()
    assert 50.0 < means["disc_loss"] < 60.0
    assert (means["disc_agent_acc"], means["disc_demo_acc"]) == (0.25, 0.75)


def test_a_published_diversity_loss_has_three_arguments(make_own):
    class Mine(GenAMPAgent):
        def _diversity_loss(  # type: ignore[override]
            self, obs: Tensor, action_params: Tensor, ase_latents: Tensor
        ) -> Tensor:
            mu, _ = self._eval_actor(obs=obs, ase_latents=self._sample_latents(len(obs)))
            assert mu.shape == action_params.shape
            assert ase_latents.shape[1] == self._latent_dim
            return 7.0 + 0.0 * mu.sum(dim=-1)

    agent = make_own(Mine, *GEN)
    agent.train()
    agent.writer.close()
    assert agent.train_info_means()["amp_diversity_loss"] == pytest.approx(7.0)


def test_a_critic_of_ones_own_values_every_state(make_own, roll_out):
    class Mine(AMPAgent):
        def _eval_critic(self, obs_dict: dict[str, Tensor]) -> Tensor:
            return torch.full((len(obs_dict["obs"]), 1), 5.0)

    agent = make_own(Mine, "task.env.enableEarlyTermination=False")
    roll_out(agent)
    assert (agent.experience_buffer.tensor_dict["next_values"] == 5.0).all()


def test_a_logger_as_published(make_own):
    seen: list[dict[str, Any]] = []

    class Mine(AMPAgent):
        def _record_train_batch_info(self, batch_dict: Any, train_info: Any) -> None:
            super()._record_train_batch_info(batch_dict, train_info)
            train_info["my_rewards"] = batch_dict["rewards"]

        def _log_train_info(self, train_info: dict[str, Any], frame: int) -> None:
            super()._log_train_info(train_info, frame)
            seen.append({**train_info, "frame": frame})

    agent = make_own(Mine)
    agent.train()
    agent.writer.close()
    assert [info["frame"] for info in seen] == [0, 32]
    lists = "entropy kl last_lr lr_mul b_loss actor_loss actor_clip_frac critic_loss disc_loss"
    for name in (*lists.split(), "disc_agent_acc", "disc_demo_logit", "disc_grad_penalty"):
        assert torch.as_tensor(seen[1][name]).isfinite().all(), name
    assert seen[1]["last_lr"][-1] * seen[1]["lr_mul"][-1] == 1e-6  # a linear schedule's last
    assert seen[1]["disc_rewards"].shape == seen[1]["my_rewards"].shape == (32, 1)
    assert seen[1]["total_time"] > seen[1]["play_time"] > 0.0


def test_random_actions_of_ones_own(make_own, roll_out):
    class Mine(AMPAgent):
        def _build_rand_action_probs(self) -> None:
            self._rand_action_probs = torch.tensor([0.0, 1.0] * 4)

    batch = roll_out(make_own(Mine))
    noise = (batch["actions"] - batch["mus"]).abs().sum(dim=-1)
    assert torch.equal(noise > 0.0, batch["rand_action_mask"] == 1.0)
    assert batch["rand_action_mask"].sum() == 16


# --- what is not here is refused ----------------------------------------------------------------


def test_an_override_that_nothing_calls_is_refused():
    names = [(ours, name) for ours, names in MISSING.items() for name in names.split()]
    for ours, name in names:
        if not name.endswith(")"):
            assert class_of(ours).replaced[name]  # `ExplainedNames` reads it
            continue
        method, _, argument = name.removesuffix(")").partition("(")
        scope: dict[str, Any] = {}
        exec(f"def {method}(self, {argument or 'anything'}=None): pass", scope)
        said = re.escape(f"Mine.{name}: nothing calls it here; ")
        with pytest.raises(OverrideError, match=said) as caught:
            type("Mine", (class_of(ours),), {method: scope[method]})
        assert "\n" not in str(caught.value)


def test_a_mixin_is_looked_at_too():
    class Debug:
        def _amp_debug(self, info: Any) -> None:
            raise NotImplementedError

    with pytest.raises(OverrideError, match="_record_step"):
        type("Mine", (Debug, AMPAgent), {})


def test_who_calls_it_may_have_it():
    class Mine(AMPAgent):
        def _record_step(self, n: int, infos: dict[str, Any]) -> None:
            super()._record_step(n, infos)
            self._amp_debug(infos)

        def _amp_debug(self, info: dict[str, Any]) -> None:
            raise NotImplementedError

    class OwnLoop(AMPPlayerContinuous):
        def run(self) -> None:
            raise NotImplementedError

        def env_reset(self, env_ids: Any = None) -> Any:
            raise NotImplementedError

    assert issubclass(Mine, PublishedNames)
    assert issubclass(OwnLoop, PublishedNames)


def test_pairs_of_demonstrations_have_a_hook_of_their_own(make_own):
    class Mine(GenAMPAgent):
        def _fetch_amp_obs_demo(self, num_samples: int) -> Tensor:
            return super()._fetch_amp_obs_demo(num_samples)

    with pytest.raises(OverrideError, match="_fetch_amp_obs_demo_pairs"):
        make_own(Mine, *GEN, f"+{CONFIG}.enc_alignment_coef=1.0")


# --- attributes ---------------------------------------------------------------------------------


@pytest.fixture(params=[AMPAgent, GenAMPAgent, HRLAgent])
def trained(request, make_agent) -> Any:
    more = {AMPAgent: (), GenAMPAgent: GEN}.get(request.param)
    if more is None:
        more = overrides(request.getfixturevalue("llc"))
    agent = make_agent(*more)
    agent.train()
    assert isinstance(agent, request.param)
    return agent


def test_published_attributes_are_read_and_not_set(trained):
    for name in same_attributes(type(trained)):
        if name != "_rand_action_probs" or isinstance(trained, AMPAgent):
            getattr(trained, name)
    assert trained._task_reward_w == trained.config["task_reward_w"]
    with pytest.raises(OverrideError, match=r"_task_reward_w .*config\.task_reward_w"):
        trained._task_reward_w = 1.0
    with pytest.raises(OverrideError, match=r"Mine\._disc_reward_w .*config\.disc_reward_w"):
        type("Mine", (type(trained),), {"_disc_reward_w": 0.5})
    with pytest.raises(AttributeError, match="rl_games names the files in nn_dir"):
        _ = trained.model_output_file
    with pytest.raises(AttributeError, match="no attribute 'nobodys'"):
        _ = trained.nobodys


def test_our_own_classes_and_plain_subclasses_pass():
    class Mine(CommonAgent):
        def helper(self) -> None:
            raise NotImplementedError

    assert Mine.helper is not None
