from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.evaluation.evaluate import EvaluationResult, episodes_to_play, evaluate


class ScriptedEnv:
    """Environments whose episodes have given lengths; the reward is the environment's number + 1.

    The agent asks for resets; `acted_on` keeps the observations that the policy saw.
    """

    def __init__(self, lengths: list[list[int]]) -> None:
        self.num_envs = len(lengths)
        self.rl_device = "cpu"
        self._lengths = lengths
        self._episode = [0] * self.num_envs
        self._step = torch.zeros(self.num_envs)
        self._done = torch.zeros(self.num_envs, dtype=torch.int64)
        self.steps = 0

    def _obs(self) -> dict[str, Tensor]:
        return {"obs": self._step.unsqueeze(1).clone()}

    def reset(self) -> dict[str, Tensor]:
        self._episode = [0] * self.num_envs
        self._step.zero_()
        self._done.zero_()
        return self._obs()

    def reset_done(self) -> tuple[dict[str, Tensor], Tensor]:
        ids = self._done.nonzero().flatten()
        for i in ids.tolist():
            self._episode[i] += 1
        self._step[ids] = 0
        self._done.zero_()
        return self._obs(), ids

    def step(self, actions: Tensor) -> tuple[Any, Tensor, Tensor, dict[str, Any]]:
        self.steps += 1
        self._step += 1
        for i, lengths in enumerate(self._lengths):
            length = lengths[min(self._episode[i], len(lengths) - 1)]
            self._done[i] = int(self._step[i] >= length)
        rewards = torch.arange(1.0, self.num_envs + 1)
        infos = {"amp_obs": actions, "terminate": self._done.clone()}
        return self._obs(), rewards, self._done.clone(), infos


def zero_policy(obs: dict[str, Tensor]) -> Tensor:
    return torch.zeros(len(obs["obs"]), 1)


def test_every_environment_plays_the_same_number_of_episodes():
    # Whoever stopped at the first four episodes would count only short ones.
    env = ScriptedEnv([[1], [10, 12]])
    result = evaluate(env, zero_policy, num_episodes=4)
    assert result.num_episodes == 4
    assert result.steps == (1 + 1 + 10 + 12) / 4
    # environment 0 earns 1 per step, environment 1 earns 2
    assert result.reward == (1 + 1 + 20 + 24) / 4
    assert env.steps == 22
    assert result.style_reward is None
    assert result.imitation is None


def test_the_number_of_episodes_is_rounded_up():
    for asked, played in ((0, 3), (3, 3), (4, 6)):
        result = evaluate(ScriptedEnv([[2], [3], [4]]), zero_policy, asked)
        assert (result.num_episodes, result.steps) == (played, 3.0)


def test_the_style_reward_is_a_mean_per_counted_step():
    env = ScriptedEnv([[2], [6]])
    seen: list[tuple[list[int], dict[str, Any]]] = []

    def on_step(dones: Tensor, infos: dict[str, Any]) -> None:
        seen.append((dones.tolist(), infos))

    def policy(obs: dict[str, Tensor]) -> Tensor:
        # the style of environment 0 is worth 10, of environment 1 it is worth 1
        return torch.tensor([[10.0], [1.0]])

    result = evaluate(env, policy, 2, style_reward=lambda amp_obs: amp_obs, on_step=on_step)
    assert result.style_reward == pytest.approx((2 * 10 + 6 * 1) / 8)
    assert [dones for dones, _ in seen] == [[0, 0], [1, 0], [0, 0], [1, 0], [0, 0], [1, 1]]
    assert all("amp_obs" in infos for _, infos in seen)


class GoalEnv(ScriptedEnv):
    """The error of an environment is its step, times ten in the second one; that one diverges."""

    progress_buf = torch.zeros(2)

    def step(self, actions: Tensor) -> tuple[Any, Tensor, Tensor, dict[str, Any]]:
        obs, rewards, dones, infos = super().step(actions)
        infos["diverged"] = torch.tensor([False, bool(self._step[1] == 3)])
        return obs, rewards, dones, infos

    def goal_errors(self) -> dict[str, Tensor]:
        return {"miss_m": self._step * torch.tensor([1.0, 10.0])}


def test_errors_of_a_goal_are_means_over_the_steps_that_count():
    # Two steps of the first one, 1 and 2; 10 and 20 of the second one, whose third step is none.
    result = evaluate(GoalEnv([[2], [3]]), zero_policy, 2)
    assert result.goal_errors == {"miss_m": pytest.approx((1 + 2 + 10 + 20) / 4)}
    assert "; miss_m 8.250" in str(result)
    assert evaluate(ScriptedEnv([[2], [3]]), zero_policy, 2).goal_errors == {}


class SuccessEnv(ScriptedEnv):
    """The success of an environment is its step, times ten in the second one."""

    def step(self, actions: Tensor) -> tuple[Any, Tensor, Tensor, dict[str, Any]]:
        obs, rewards, dones, infos = super().step(actions)
        infos["successes"] = {"goals_reached": self._step * torch.tensor([1.0, 10.0])}
        return obs, rewards, dones, infos


def test_successes_are_means_over_the_ends_of_episodes():
    # The third episode of the first environment does not count.
    result = evaluate(SuccessEnv([[2, 4, 1], [9]]), zero_policy, 2)
    assert result.successes == {"goals_reached": (2 + 90) / 2}
    result = evaluate(SuccessEnv([[2, 4, 1], [9]]), zero_policy, 4)
    assert result.successes == {"goals_reached": (2 + 4 + 90 + 90) / 4}
    assert "; goals reached 46.500; falls" in str(result)
    assert evaluate(ScriptedEnv([[2], [3]]), zero_policy, 2).successes == {}


def test_the_policy_sees_observations_after_resets():
    observed = []

    def policy(obs: dict[str, Tensor]) -> Tensor:
        observed.append(obs["obs"].flatten().tolist())
        assert not torch.is_grad_enabled()
        return zero_policy(obs)

    evaluate(ScriptedEnv([[2], [3]]), policy, 2)
    assert observed == [[0.0, 0.0], [1.0, 1.0], [0.0, 2.0]]


def test_the_result_is_one_line():
    result = EvaluationResult(4, 12.5, 6.75, 0.25, None)
    assert str(result) == (
        "4 episodes; reward 12.50; episode length 6.8 steps; style reward 0.250 per step; falls 0%"
    )
    assert "style" not in str(EvaluationResult(4, 1.0, 2.0, None, None))


def test_a_published_number_without_end_comes_to_one(caplog) -> None:
    caplog.set_level("INFO")
    assert episodes_to_play({}) == 32
    assert episodes_to_play({"games_num": 100}) == 100
    assert not caplog.text
    assert episodes_to_play({"games_num": 1_000_000}) == 32
    assert "games_num=1000000 means without end" in caplog.text


def test_nobody_learns_from_a_task_while_it_is_evaluated() -> None:
    env = ScriptedEnv([[2], [3]])
    env.is_training = before = True
    seen = []
    evaluate(env, zero_policy, 2, on_step=lambda *_: seen.append(env.is_training))
    assert seen == [False] * 3
    assert env.is_training is before

    def broken(obs: dict[str, Tensor]) -> Tensor:
        raise ValueError

    with pytest.raises(ValueError):
        evaluate(env, broken, 2)
    assert env.is_training is before
