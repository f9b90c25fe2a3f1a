"""Agents with tiny networks on a few real humanoids."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from rl_games.common.algo_observer import AlgoObserver
from torch import Tensor

from isaacgymenvs_lite.config.train_params import KnownNames, prepare_train_params
from isaacgymenvs_lite.env_factory import make_from_config
from isaacgymenvs_lite.learning.amp_config import AGENT_KEYS
from isaacgymenvs_lite.registration import build_runner, register_env
from tests.tiny import CONFIG, ONE_THREAD, TINY_AMP, composed

_TINY = (
    "task=HumanoidAMP",
    *TINY_AMP,
    "train.params.network.disc.units=[16,8]",
    f"{CONFIG}.minibatch_size=16",
    f"{CONFIG}.mini_epochs=2",
    f"{CONFIG}.learning_rate=5e-5",
    f"{CONFIG}.disc_grad_penalty=5",
    f"{CONFIG}.amp_minibatch_size=8",
    f"{CONFIG}.amp_obs_demo_buffer_size=40",
)


@pytest.fixture
def make_runner(tmp_path: Path, walk_clip: Path) -> Iterator[Callable[..., Any]]:
    """Return make(*overrides, num_envs=8, observer=None), a loaded Runner with its task."""
    tasks = []

    def make(*overrides: str, num_envs: int = 8, observer: AlgoObserver | None = None) -> Any:
        cfg = composed(
            [*_TINY, f"task.env.motion_file={walk_clip}", f"num_envs={num_envs}", *overrides]
        )
        task = make_from_config(cfg, sim_device="cpu", rl_device="cpu")
        tasks.append(task)
        register_env(lambda **kwargs: task)
        runner = build_runner(observer)
        keys = [*AGENT_KEYS, "imitation_frequency", "print_disc_prediction"]
        params = prepare_train_params(
            cfg,
            num_envs=num_envs,
            seed=1,
            run_name=f"run{len(tasks)}",
            rl_device="cpu",
            names=KnownNames(config_keys=keys),
        )
        params["config"]["train_dir"] = str(tmp_path / "runs")
        params["torch_threads"] = 1
        runner.load({"params": params})
        return runner

    yield make
    for task in tasks:
        task.close()


@pytest.fixture
def make_classic_runner(tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Return make(*overrides), a Runner that has loaded a classic task and its train file."""
    tasks = []

    def make(*overrides: str) -> Any:
        cfg = composed([*ONE_THREAD, *overrides])
        torch.manual_seed(0)
        task = make_from_config(cfg, sim_device="cpu", rl_device="cpu")
        tasks.append(task)
        register_env(lambda **kwargs: task)
        params = prepare_train_params(
            cfg, num_envs=task.num_envs, seed=1, run_name=f"run{len(tasks)}", rl_device="cpu"
        )
        params["config"]["train_dir"] = str(tmp_path / "runs")
        params["torch_threads"] = 1
        runner = build_runner()
        runner.load({"params": params})
        return runner

    yield make
    register_env()
    for task in tasks:
        task.close()


@pytest.fixture
def make_classic_agent(make_classic_runner: Callable[..., Any]) -> Callable[..., Any]:
    """Return make(*overrides) as `make_classic_runner`, an agent before its first epoch."""

    def make(*overrides: str) -> Any:
        runner = make_classic_runner(*overrides)
        params = runner.params
        agent = runner.algo_factory.create(runner.algo_name, base_name="run", params=params)
        runner.algo_observer.before_init("run", params["config"], agent.experiment_name)
        return agent

    return make


@pytest.fixture
def make_agent(make_runner: Callable[..., Any]) -> Iterator[Callable[..., Any]]:
    """Return make(*overrides, ...) as `make_runner`, an agent before its first epoch."""
    agents = []

    def make(*overrides: str, **kwargs: Any) -> Any:
        runner = make_runner(*overrides, **kwargs)
        agent = runner.algo_factory.create(runner.algo_name, base_name="run", params=runner.params)
        agents.append(agent)
        return agent

    yield make
    for agent in agents:
        agent.writer.close()


class Tape:
    """What went through an agent's vec-env, per step; see `record`."""

    def __init__(self) -> None:
        self.before: list[Tensor] = []
        """Observations that `reset_done` gave."""
        self.after: list[Tensor] = []
        """Observations that `step` gave, terminal ones included."""
        self.actions: list[Tensor] = []
        self.rewards: list[Tensor] = []
        self.dones: list[Tensor] = []
        self.terminate: list[Tensor] = []
        self.amp_obs: list[Tensor] = []


@pytest.fixture
def record() -> Callable[..., Tape]:
    """Return a function (agent, falls=()) that taps the agent's vec-env.

    `falls` are pairs (step, environment) at which an episode is made to end by a failure.
    """

    def tap(agent: Any, falls: tuple[tuple[int, int], ...] = ()) -> Tape:
        tape, vec_env = Tape(), agent.vec_env
        step, reset_done = vec_env.step, vec_env.reset_done

        def taped_reset_done() -> Any:
            obs, ids = reset_done()
            tape.before.append(obs["obs"].clone())
            return obs, ids

        def taped_step(actions: Tensor) -> Any:
            obs, rewards, dones, infos = step(actions)
            for at, env in falls:
                if at == len(tape.after):
                    dones[env] = infos["terminate"][env] = vec_env.env.reset_buf[env] = 1
            tape.after.append(obs["obs"].clone())
            tape.actions.append(actions.clone())
            tape.rewards.append(rewards.clone())
            tape.dones.append(dones.clone())
            tape.terminate.append(infos["terminate"].clone())
            tape.amp_obs.append(infos["amp_obs"].clone())
            return obs, rewards, dones, infos

        vec_env.step, vec_env.reset_done = taped_step, taped_reset_done
        return tape

    return tap


@pytest.fixture
def roll_out() -> Callable[[Any], dict[str, Any]]:
    """Return a function (agent) that makes one rollout as an epoch does."""

    def once(agent: Any) -> dict[str, Any]:
        agent.init_tensors()
        agent.obs = agent.env_reset()
        agent.set_eval()
        with torch.no_grad():
            return agent.play_steps()

    return once


@pytest.fixture
def scramble() -> Callable[[Any], None]:
    """Return a function (agent) that gives the normalisers noticeable statistics."""

    def scramble_normalisers(agent: Any) -> None:
        generator = torch.Generator().manual_seed(5)
        for normalizer in (
            agent.model.running_mean_std,
            agent.model.value_mean_std,
            agent.discriminator.normalizer,
        ):
            shape = normalizer.running_mean.shape
            normalizer.running_mean.copy_(torch.rand(shape, generator=generator) + 0.5)
            normalizer.running_var.copy_(torch.rand(shape, generator=generator) + 2.0)
            normalizer.count.fill_(100.0)

    return scramble_normalisers


def make_training_set(agent: Any, batch: dict[str, Any]) -> dict[str, Tensor]:
    """Fill the agent's dataset with a rollout as an epoch does; return its rows."""
    agent.set_train()
    agent.prepare_dataset(batch)
    return agent.dataset.values_dict


def prepared_minibatch(agent: Any, roll_out: Callable[[Any], Any]) -> dict[str, Tensor]:
    make_training_set(agent, roll_out(agent))
    return agent.dataset[0]


def mean_actions(agent: Any, obs: Tensor, *latents: Tensor) -> Tensor:
    """Return the policy's mean actions for raw observations."""
    agent.model.eval()
    with torch.no_grad():
        return agent.model.a2c_network.eval_actor(agent.model.norm_obs(obs), *latents)[0]


@contextmanager
def model_inputs(agent: Any) -> Iterator[list[dict[str, Any]]]:
    """Collect the inputs of the agent's model."""
    inputs: list[dict[str, Any]] = []
    handle = agent.model.register_forward_pre_hook(lambda _, args: inputs.append(dict(args[0])))
    yield inputs
    handle.remove()


def check_slices(
    make: Callable[..., Any], roll_out: Callable[[Any], Any], *overrides: str
) -> dict[str, torch.Tensor]:
    """Check that three slices of a minibatch give the losses and gradients of the whole.

    Returns:
        The rows of the minibatch, derived ones included.
    """
    config = "train.params.config"
    agent = make(
        *overrides,
        f"{config}.minibatch_size=1024",
        f"{config}.amp_minibatch_size=256",
        f"{config}.amp_obs_demo_buffer_size=1024",
        f"{config}.horizon_length=16",
        num_envs=64,
    )
    rows = agent.prepare_minibatch(prepared_minibatch(agent, roll_out))
    learned = [p for p in agent.model.parameters() if p.requires_grad]

    def gradients(threads: int) -> tuple[Any, Any]:
        agent.executor.num_threads = threads
        return agent.executor.gradients(agent.compute_loss, dict(rows), learned)

    whole, values = gradients(1)
    sliced, sliced_values = gradients(3)
    for name, value in values.items():
        torch.testing.assert_close(sliced_values[name], value, rtol=1e-4, atol=1e-5)
    for own, other in zip(sliced, whole, strict=True):
        torch.testing.assert_close(own, other, rtol=1e-3, atol=1e-5)
    return rows
