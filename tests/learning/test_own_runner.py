"""Trainings in a Runner of the user's own, with files that do not mention torch.compile."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from rl_games.algos_torch import model_builder
from rl_games.common.algo_observer import DefaultAlgoObserver
from rl_games.torch_runner import Runner

from isaacgymenvs_lite.config.train_files import load_train_file, read_train_file
from isaacgymenvs_lite.config.train_params import torch_compile_setting
from isaacgymenvs_lite.learning.amp_continuous import AMPAgent
from isaacgymenvs_lite.learning.amp_models import ModelAMPContinuous
from isaacgymenvs_lite.learning.amp_network_builder import AMPBuilder
from isaacgymenvs_lite.learning.gen_amp_network_builder import GenAMPBuilder
from isaacgymenvs_lite.registration import register, register_env
from tests.learning.test_gen_amp import CONFIG, GEN_AMP
from tests.learning.test_hrl import llc, overrides, save_train_file  # noqa: F401  a fixture

ONE_EPOCH = "max_iterations=1"


@pytest.fixture(autouse=True)
def no_compiler(monkeypatch) -> None:
    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise AssertionError("a model is being compiled")

    monkeypatch.setattr(torch, "compile", refuse)


def without_the_key(runner: Any) -> dict[str, Any]:
    """Return what the runner has loaded, as a file that does not mention torch.compile."""
    params = runner.default_config
    params["config"].pop("torch_compile", None)
    params["config"]["reward_shaper"] = {}
    return {"params": params}


@pytest.mark.parametrize("algo", ["amp_agent", "amp_continuous", "gen_amp", "hrl"])
def test_agents_of_ours_do_not_compile(algo, make_runner, request):
    more: tuple[str, ...] = (f"train.params.algo.name={algo}",)
    if algo == "gen_amp":
        more = GEN_AMP
    elif algo == "hrl":
        more = overrides(request.getfixturevalue("llc"))
    loaded = without_the_key(make_runner(*more, ONE_EPOCH))
    runner = Runner()
    register(runner)
    runner.load(loaded)
    runner.run({"train": True})
    assert runner.params["config"]["torch_compile"] is False


@pytest.mark.parametrize("task", ["Cartpole", "AntSAC"])
def test_agents_of_rl_games_do_not_compile_on_a_cpu(task, make_classic_runner):
    small = {
        "Cartpole": ("num_envs=8", f"{CONFIG}.minibatch_size=128"),
        "AntSAC": ("num_envs=4", "train=AntSAC", f"{CONFIG}.replay_buffer_size=1000"),
    }
    loaded = without_the_key(make_classic_runner(f"task={task}", *small[task], ONE_EPOCH))
    runner = Runner()
    register(runner)
    runner.load(loaded)
    runner.run({"train": True})
    assert runner.params["config"]["torch_compile"] is False


def test_an_agent_that_is_registered_by_hand(make_runner):
    loaded = without_the_key(make_runner("train.params.algo.name=amp_agent", ONE_EPOCH))
    agents: list[AMPAgent] = []

    def build(**kwargs: Any) -> AMPAgent:
        agents.append(AMPAgent(**kwargs))
        return agents[-1]

    runner = Runner()
    runner.algo_factory.register_builder("amp_agent", build)
    model_builder.register_model("continuous_amp", ModelAMPContinuous)
    model_builder.register_network("amp", AMPBuilder)
    runner.load(loaded)
    runner.run({"train": True})
    assert agents[0].epoch_num == 1
    # IsaacGymEnvs' reward, under whatever name: ln 2 times the scale for a logit of 0
    reward = agents[0].discriminator.reward_from_logits(torch.zeros(1))
    assert reward.item() == pytest.approx(0.693147 * agents[0]._disc_reward_scale, rel=1e-5)


class CountingBuilder(GenAMPBuilder):
    """A user's own network, which says how often it was built."""

    built = 0

    def build(self, name: str, **kwargs: Any) -> Any:
        type(self).built += 1
        return super().build(name, **kwargs)


def train_own(file: Path | str, folder: Path, task: str, **more: Any) -> Any:
    """Train one small epoch of a train file in an own Runner; return the agent.

    The file is shrunk by its values alone: what rl_games needs is in it.
    """
    loaded = load_train_file(file, num_envs=8)
    network, config = loaded["params"]["network"], loaded["params"]["config"]
    for section in {"mlp", "disc", "enc", "style"} & set(network):
        network[section]["units"] = [16, 8]
    small = {"horizon_length": 4, "minibatch_size": 32, "mini_epochs": 1, "batch_size": 16}
    config |= {key: small[key] for key in small if key in config}
    config |= {"train_dir": str(folder), "max_epochs": 1, **more}
    if task != "HumanoidAMP":  # that is the default of `isaacgymenvs_lite.make`
        config["env_config"] = {"task": task}
    agents: list[Any] = []

    class Observer(DefaultAlgoObserver):
        def after_init(self, algo: Any) -> None:
            agents.append(algo)
            super().after_init(algo)

    runner = Runner(Observer())
    register(runner)
    register_env()
    runner.load(loaded)
    runner.run({"train": True})
    return agents[0]


SMALL_AMP = {
    **{"amp_minibatch_size": 8, "amp_batch_size": 16, "amp_replay_buffer_size": 64},
    **{"amp_obs_demo_buffer_size": 32, "warm_start_steps": 2},
}


@pytest.mark.parametrize(
    ("file", "task", "more"),
    [
        ("CartpolePPO", "Cartpole", {}),
        ("AntSAC", "Ant", {"replay_buffer_size": 1000}),
        ("HumanoidAMPPPO", "HumanoidAMP", SMALL_AMP),
        ("HumanoidASETaskPPO", "HumanoidHeading", {}),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in (
                ("RobotAMPPPO", "RobotAMP", SMALL_AMP),
                ("HumanoidASEPPO", "HumanoidASE", SMALL_AMP),
                ("HumanoidASEHRLPPO", "HumanoidHeading", {}),
            )
        ),
    ],
)
def test_files_train_as_they_are_read(file, task, more: dict[str, Any], tmp_path):
    agent = train_own(file, tmp_path, task, **more)
    assert agent.vec_env.env.num_envs == 8
    assert agent.config["device_name"] == "cpu"
    assert list(tmp_path.glob("*/nn/*.pth"))


@pytest.mark.slow
def test_a_published_file_without_interpolations(tmp_path):
    """ASE's train.py adds device, environments and a seed in place of -1, which numpy refuses."""
    loaded = read_train_file("HumanoidAMPPPO")
    for key in ("device", "device_name", "num_actors"):
        del loaded["params"]["config"][key]
    loaded["params"]["seed"] = -1
    loaded["params"]["config"]["minibatch_size"] = 16384
    OmegaConf.save(OmegaConf.create(loaded), tmp_path / "ase.yaml")
    agent = train_own(tmp_path / "ase.yaml", tmp_path, "HumanoidAMP", **SMALL_AMP)
    assert agent.vec_env.env.num_envs == 8


@pytest.mark.slow
def test_agents_of_rl_games_itself_take_our_files(tmp_path):
    """They refuse the text `auto` of `mixed_precision`."""
    register_env()
    loaded = load_train_file("AntSAC", num_envs=4)
    config = loaded["params"]["config"]
    config |= {"env_config": {"task": "Ant"}, "replay_buffer_size": 1000, "batch_size": 16}
    config |= {"train_dir": str(tmp_path), "max_epochs": 1, "torch_compile": False}
    runner = Runner()
    runner.load(loaded)
    runner.run({"train": True})
    assert list(tmp_path.glob("*/nn/*.pth"))


@pytest.mark.slow
def test_skills_and_a_hierarchy_on_a_task_by_its_name(tmp_path):
    """The task has a goal; skills are not rewarded for it, nor observe it."""
    skills = train_own("HumanoidASEPPO", tmp_path / "skills", "HumanoidASE", **SMALL_AMP)
    task = skills.vec_env.env
    assert task.get_task_obs_size() == 5  # heading
    assert skills.num_policy_obs == task.num_obs - 5
    assert task.rew_buf.std() > 0.0
    (file,) = (tmp_path / "skills").glob("*/nn/*.pth")
    skills.network.network_builder.params["name"] = "own"
    save_train_file(skills, tmp_path / "llc.yaml")
    keys: dict[str, Any] = {"llc_config": str(tmp_path / "llc.yaml"), "llc_checkpoint": str(file)}
    model_builder.register_network("own", CountingBuilder)
    hierarchy = train_own("HumanoidASEHRLPPO", tmp_path / "hrl", "HumanoidASE", **keys)
    assert CountingBuilder.built == 1
    assert hierarchy.llc.num_task_obs == 5
    assert hierarchy.llc.num_character_obs == skills.num_policy_obs


@pytest.mark.parametrize(
    ("asked", "device", "can_compile", "expected"),
    [
        (None, "cpu", True, False),
        (None, "cuda:0", True, True),
        (True, "cpu", True, True),
        (True, "cuda:0", True, True),
        (False, "cuda:0", True, False),
        ("max-autotune", "cuda:0", True, "max-autotune"),
        ("default", "cpu", False, False),
        (None, "cuda:0", False, False),
        (True, "cuda:0", False, False),
    ],
)
def test_who_compiles(asked, device, can_compile, expected):
    assert torch_compile_setting(asked, device, can_compile=can_compile) == expected


def test_a_user_s_wish_is_kept_where_it_can_be(make_classic_agent: Callable[..., Any]):
    agent = make_classic_agent("task=Cartpole", "num_envs=8", f"+{CONFIG}.torch_compile=True")
    assert agent.config["torch_compile"] is True
