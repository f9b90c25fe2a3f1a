"""AMPAgent in rl_games' own train() loop: stop rules, checkpoints, resuming."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from isaacgymenvs_lite.errors import CheckpointError
from tests.learning.conftest import make_training_set

CONFIG = "train.params.config"
# Without falls of its own an environment times out after 2 control steps.
VERY_SHORT_EPISODES = ("task.env.episodeLength=3", "task.env.enableEarlyTermination=False")


def snapshot(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in module.state_dict().items()}


def same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(first[name], second[name]) for name in first)


def names_in(agent: Any) -> list[str]:
    return sorted(path.name for path in Path(agent.nn_dir).iterdir())


def test_max_epochs_is_exact(make_agent):
    agent = make_agent("max_iterations=3")
    agent.train()
    assert agent.epoch_num == 3
    assert agent.frame == 3 * 32
    assert len(names_in(agent)) == 1
    assert names_in(agent)[0].startswith("last_HumanoidAMP_ep_3_rew_")


def test_max_frames_ends_the_training(make_agent):
    agent = make_agent("max_iterations=100", f"+{CONFIG}.max_frames=65")
    agent.train()
    assert agent.frame == 96
    assert names_in(agent)[0].startswith("last_HumanoidAMP_frame_96_rew_")


def test_the_best_checkpoint_is_saved_after_save_best_after(make_agent):
    agent = make_agent(*VERY_SHORT_EPISODES, "max_iterations=3", f"{CONFIG}.save_best_after=2")
    saved = []
    save = agent.save
    agent.save = lambda fn: saved.append((agent.epoch_num, Path(fn).name)) or save(fn)
    agent.train()
    # every episode earns the same: the first look after epoch 2 is the best one
    assert saved[0] == (2, "HumanoidAMP")
    assert [name for _, name in saved].count("HumanoidAMP") == 1
    assert "HumanoidAMP.pth" in names_in(agent)


def test_an_agent_sets_the_flag_of_its_task(make_agent):
    agent = make_agent("max_iterations=1")
    assert not agent.vec_env.env.is_training
    agent.train()
    assert agent.vec_env.env.is_training


SCHEDULED = (f"{CONFIG}.disc_grad_penalty=5", f"{CONFIG}.disc_grad_penalty_final=0.2")


def test_the_gradient_penalty_follows_the_length_of_episodes(make_agent):
    """Of a policy that always reaches the time limit; 0.05 of what is left in an epoch."""
    agent = make_agent(*VERY_SHORT_EPISODES, *SCHEDULED)
    agent.max_epochs = 4
    agent.train()
    # In the first epoch episodes have ended, too: their limit is two steps.
    assert agent.staying_up == pytest.approx(1.0 - 0.95**4)
    expected = 5.0 ** (1.0 - agent.staying_up) * 0.2**agent.staying_up
    assert agent.discriminator.grad_penalty == pytest.approx(expected)


def test_the_gradient_penalty_stays_where_episodes_are_short(make_agent):
    agent = make_agent(*SCHEDULED)  # the clips' bodies fall at once
    agent.max_epochs = 3
    agent.train()
    assert agent.staying_up < 0.2
    assert agent.discriminator.grad_penalty > 3.0


CONSTANT = f"{CONFIG}.disc_grad_penalty_final=null"


def test_without_a_final_value_the_gradient_penalty_is_constant(make_agent):
    agent = make_agent(*VERY_SHORT_EPISODES, CONSTANT)
    agent.max_epochs = 2
    agent.train()
    assert agent.discriminator.grad_penalty == 5.0


def test_score_to_win_ends_the_training(make_agent):
    agent = make_agent(
        *VERY_SHORT_EPISODES,
        "max_iterations=100",
        f"{CONFIG}.save_best_after=1",
        f"{CONFIG}.score_to_win=1.5",
    )
    reward, epochs = agent.train()
    assert epochs == agent.epoch_num == 1
    assert reward == pytest.approx(2.0)
    assert any("_ep_1_rew_" in name for name in names_in(agent))


def test_intermediate_checkpoints(make_agent):
    agent = make_agent(*VERY_SHORT_EPISODES, "max_iterations=4", f"{CONFIG}.save_frequency=2")
    agent.train()
    kept = [name for name in names_in(agent) if name.startswith("last_HumanoidAMP_ep_")]
    assert {name.split("_")[3] for name in kept} == {"2", "4"}


# --- resuming ---------------------------------------------------------------------------------


@pytest.fixture
def trained(make_agent) -> Any:
    # Its schedule is part of the state for `resume=`, and not of a checkpoint.
    agent = make_agent(*VERY_SHORT_EPISODES, CONSTANT, f"{CONFIG}.save_best_after=1")
    agent.train()
    return agent


def saved_at(agent: Any, path: Path) -> str:
    agent.save(str(path / "model"))
    return str(path / "model.pth")


def test_resuming_restores_everything(trained, make_agent, tmp_path):
    trained.last_mean_rewards = 12.5
    checkpoint = saved_at(trained, tmp_path)
    agent = make_agent()
    agent.restore(checkpoint)
    assert (agent.epoch_num, agent.frame) == (2, 64)
    assert agent.last_mean_rewards == 12.5
    assert same(snapshot(agent.model), snapshot(trained.model))
    assert same(
        snapshot(agent.discriminator.normalizer), snapshot(trained.discriminator.normalizer)
    )
    assert agent.discriminator.normalizer.count.item() > 1.0
    own, other = agent.optimizer.state_dict(), trained.optimizer.state_dict()
    assert own["state"].keys() == other["state"].keys() != set()
    for index, moments in own["state"].items():
        assert same(moments, other["state"][index])


def test_a_resumed_training_takes_the_same_gradient_step(trained, make_agent, tmp_path):
    trained.init_tensors()
    trained.obs = trained.env_reset()
    with torch.no_grad():
        batch = trained.play_steps()
    make_training_set(trained, batch)
    minibatch = trained.dataset[0]
    checkpoint = saved_at(trained, tmp_path)
    agent = make_agent()
    agent.restore(checkpoint)
    for each in (trained, agent):
        each.train_actor_critic({name: value.clone() for name, value in minibatch.items()})
    assert same(snapshot(agent.model), snapshot(trained.model))


def test_a_learning_rate_that_comes_down_goes_on_where_it_was(trained, make_agent, tmp_path):
    """It is 1e-6 at the end; of four epochs half way from the first, 5e-5."""
    assert trained.last_lr == pytest.approx(1e-6)
    agent = make_agent("max_iterations=4")
    agent.restore(saved_at(trained, tmp_path))
    own, of_discriminator = (group["lr"] for group in agent.optimizer.param_groups)
    assert agent.last_lr == own == pytest.approx(1e-6 + (5e-5 - 1e-6) / 2)
    assert of_discriminator == 5e-5


def test_resuming_goes_on_counting(trained, make_agent, tmp_path):
    checkpoint = saved_at(trained, tmp_path)
    agent = make_agent("max_iterations=4")
    agent.restore(checkpoint)
    agent.train()
    assert (agent.epoch_num, agent.frame) == (4, 128)


def test_a_worse_model_does_not_replace_the_best_of_before(trained, make_agent, tmp_path):
    trained.last_mean_rewards = 1000.0
    checkpoint = saved_at(trained, tmp_path)
    agent = make_agent(*VERY_SHORT_EPISODES, "max_iterations=4", f"{CONFIG}.save_best_after=1")
    agent.restore(checkpoint)
    agent.train()
    assert agent.last_mean_rewards == 1000.0
    assert "HumanoidAMP.pth" not in names_in(agent)


def test_a_better_model_replaces_the_best_of_before(trained, make_agent, tmp_path):
    trained.last_mean_rewards = 0.5
    checkpoint = saved_at(trained, tmp_path)
    agent = make_agent(*VERY_SHORT_EPISODES, "max_iterations=4", f"{CONFIG}.save_best_after=1")
    agent.restore(checkpoint)
    agent.train()
    assert agent.last_mean_rewards == pytest.approx(2.0)
    assert "HumanoidAMP.pth" in names_in(agent)


def test_the_checkpoint_has_the_documented_keys(trained, tmp_path):
    state = torch.load(saved_at(trained, tmp_path), weights_only=True)
    assert set(state) == {
        "model",
        "epoch",
        "frame",
        "optimizer",
        "last_mean_rewards",
        "env_state",
        "amp_input_mean_std",
    }
    statistics = state["amp_input_mean_std"]
    assert {k: tuple(v.shape) for k, v in statistics.items()} == {
        "running_mean": (210,),
        "running_var": (210,),
        "count": (),
    }
    assert not [name for name in state["model"] if "amp_input" in name]
    assert isinstance(state["last_mean_rewards"], float)


def test_without_normaliser_the_checkpoint_has_no_statistics(make_agent, tmp_path):
    agent = make_agent(f"{CONFIG}.normalize_amp_input=False")
    agent.train()
    checkpoint = saved_at(agent, tmp_path)
    assert "amp_input_mean_std" not in torch.load(checkpoint, weights_only=True)
    make_agent(f"{CONFIG}.normalize_amp_input=False").restore(checkpoint)


@pytest.mark.parametrize("key", ["amp_input_mean_std", "epoch", "optimizer"])
def test_training_on_from_less_than_a_training_state_is_a_users_error(
    key, trained, make_agent, tmp_path
):
    """Such as a file of a run with normalize_amp_input=False, or one that kept the model only."""
    whole = torch.load(saved_at(trained, tmp_path), weights_only=True)
    torch.save({k: v for k, v in whole.items() if k != key}, tmp_path / "less.pth")
    with pytest.raises(CheckpointError, match=key):
        make_agent().restore(str(tmp_path / "less.pth"))
