from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from rl_games.common import env_configurations

from isaacgymenvs_lite.wrappers.rl_games_env import RLGPUEnv


class StubTask:
    """Records the calls and returns fixed tensors."""

    num_agents = 2
    num_states = 0
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (5,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)

    def __init__(self, **kwargs: Any) -> None:
        self.kwargs = kwargs
        self.calls: list[tuple[str, Any]] = []

    def step(self, actions: torch.Tensor) -> Any:
        self.calls.append(("step", actions))
        return {"obs": actions + 1}, torch.ones(2), torch.zeros(2), {"time_outs": None}

    def reset(self) -> Any:
        self.calls.append(("reset", None))
        return {"obs": torch.zeros(2, 5)}

    def reset_done(self) -> Any:
        self.calls.append(("reset_done", None))
        return {"obs": torch.zeros(2, 5)}, torch.tensor([1])

    def set_train_info(self, *args: Any, **kwargs: Any) -> None:
        self.calls.append(("set_train_info", (args, kwargs)))

    def get_env_state(self) -> Any:
        return {"level": 3}

    def set_env_state(self, env_state: Any) -> None:
        self.calls.append(("set_env_state", env_state))

    def close(self) -> None:
        self.calls.append(("close", None))


class StubAMPTask(StubTask):
    num_states = 4
    state_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float32)
    amp_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (7,), np.float32)


@pytest.fixture
def make_env(monkeypatch):
    def make(task_class: type = StubTask, **kwargs: Any) -> RLGPUEnv:
        monkeypatch.setitem(
            env_configurations.configurations,
            "stub",
            {"vecenv_type": "RLGPU", "env_creator": task_class},
        )
        return RLGPUEnv("stub", 16, **kwargs)

    return make


def test_calls_pass_through_unchanged(make_env):
    env = make_env()
    actions = torch.ones(2, 3)
    obs, rewards, dones, infos = env.step(actions)
    assert env.env.calls[-1][1] is actions
    assert torch.equal(obs["obs"], actions + 1)
    assert rewards.tolist() == [1, 1]
    assert dones.tolist() == [0, 0]
    assert infos == {"time_outs": None}
    assert env.reset()["obs"].shape == (2, 5)
    obs, ids = env.reset_done()
    assert ids.tolist() == [1]
    assert obs["obs"].shape == (2, 5)
    env.set_train_info(100, "agent")
    assert env.env.calls[-1] == ("set_train_info", ((100, "agent"), {}))
    assert env.get_env_state() == {"level": 3}
    env.set_env_state({"level": 4})
    assert env.env.calls[-1] == ("set_env_state", {"level": 4})
    env.close()
    assert env.env.calls[-1] == ("close", None)


class StubRequestTask(StubTask):
    agents_call_reset_done = True


def test_agents_that_never_call_reset_done_get_resets_within_the_step(make_env):
    env = make_env(StubRequestTask)
    obs, *_ = env.step(torch.ones(2, 3))
    assert [name for name, _ in env.env.calls] == ["step", "reset_done"]
    assert torch.equal(obs["obs"], torch.zeros(2, 5))  # the next episode's


def test_an_agent_that_calls_reset_done_gets_the_last_observations(make_env):
    env = make_env(StubRequestTask)
    env.reset_done()
    obs, *_ = env.step(torch.ones(2, 3))
    assert [name for name, _ in env.env.calls] == ["reset_done", "step"]
    assert torch.equal(obs["obs"], torch.full((2, 3), 2.0))


def test_spaces_of_a_task_with_references_and_privileged_states(make_env):
    info = make_env(StubAMPTask).get_env_info()
    assert info["amp_observation_space"].shape == (7,)
    assert info["state_space"].shape == (4,)
