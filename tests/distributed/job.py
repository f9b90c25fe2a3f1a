"""What torchrun starts for the tests: `-m tests.distributed.job FOLDER`.

Trains agents, one after another, and writes what each process has learned to
FOLDER/<name>_<rank>.pth. The main process adds what the first gradient step would have been in one
process with the rows of all.
"""

from __future__ import annotations

import contextlib
import copy
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from torch import Tensor

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.learning.common_agent import CommonAgent
from isaacgymenvs_lite.learning.cpu.parallel import NetworkExecutor
from isaacgymenvs_lite.learning.ppo import PPOAgent
from isaacgymenvs_lite.learning.safeguards import PPOSafeguards
from isaacgymenvs_lite.runner import run
from tests.tiny import CONFIG, TINY_AMP, TINY_LSTM, TINY_PPO, TINY_STYLE

ADAPTIVE = f"{CONFIG}.lr_schedule=adaptive"
TOGETHER = ("multi_gpu=True", "num_envs=16", "max_iterations=3", f"{CONFIG}.truncate_grads=False")
SHORT = "task.env.episodeLength=5"
AGENTS = {
    "ppo": ("task=Ant", *TINY_PPO, ADAPTIVE, SHORT, *TOGETHER),
    "asymmetric": ("task=AnymalTerrain", "train=AnymalTerrainPPO", *TINY_PPO, *TOGETHER),
    "lstm": (*TINY_LSTM, *TOGETHER),
    "amp": (
        "task=HumanoidAMP",
        *TINY_AMP,
        ADAPTIVE,
        SHORT,
        f"+{CONFIG}.enable_eps_greedy=True",
        *TOGETHER,
    ),
    "gen_amp": ("task=HumanoidASE", *TINY_AMP, *TINY_STYLE, SHORT, *TOGETHER),
}
RANK = int(os.environ.get("RANK", "0"))

# Whose first step is compared with one process' step.
WITH_FIRST_STEP = ("ppo", "amp", "gen_amp", "hrl")


def learned(agent: Any) -> dict[str, Any]:
    """Return what must be equal in all processes."""
    parts = agent._parts()
    modules = {key: module.state_dict() for key, module in parts.modules.items()}
    optimizers = {key: optimizer.state_dict() for key, optimizer in parts.optimizers.items()}
    return {
        "modules": modules,
        "optimizers": optimizers,
        "frame": agent.frame,
        "epoch": agent.epoch_num,
        "last_lr": agent.last_lr,
    }


class FirstStep:
    """Records the first gradient step: minibatch, counts of normalisers, gradients."""

    def __init__(self) -> None:
        self.record: dict[str, Any] = {}
        self._patches = pytest.MonkeyPatch()

    def __enter__(self) -> FirstStep:
        calc, gradients_of = CommonAgent.calc_gradients, NetworkExecutor.gradients
        step_of_own = CommonAgent.trancate_gradients_and_step
        train, step_of_ppo = PPOAgent.train_actor_critic, PPOAgent.trancate_gradients_and_step

        def calc_gradients(agent: Any, minibatch: dict[str, Tensor]) -> Any:
            self._begin(agent, minibatch)
            self._agent = agent
            return calc(agent, minibatch)

        def gradients(executor: Any, function: Any, rows: dict[str, Tensor], *others: Any) -> Any:
            if "rows" not in self.record:
                self.record["rows"] = {k: v for k, v in rows.items() if v is not None}
                counted = self._agent.get_stats_weights(model_stats=True)
                self.record["counted"] = _copied(counted)
            return gradients_of(executor, function, rows, *others)

        def train_actor_critic(agent: Any, minibatch: dict[str, Tensor]) -> Any:
            self._begin(agent, minibatch)
            result = train(agent, minibatch)
            if "counted" not in self.record:
                self.record["counted"] = _copied(agent.get_stats_weights(model_stats=True))
            return result

        def recorded(step: Callable[[Any], None]) -> Callable[[Any], None]:
            def trancate_gradients_and_step(agent: Any) -> None:
                own = _gradients(agent)
                step(agent)
                if "gradients" not in self.record:
                    self.record["own_gradients"] = own
                    self.record["gradients"] = _gradients(agent)

            return trancate_gradients_and_step

        self._patches.setattr(CommonAgent, "calc_gradients", calc_gradients)
        self._patches.setattr(NetworkExecutor, "gradients", gradients)
        self._patches.setattr(PPOAgent, "train_actor_critic", train_actor_critic)
        name = "trancate_gradients_and_step"
        self._patches.setattr(CommonAgent, name, recorded(step_of_own))
        self._patches.setattr(PPOAgent, name, recorded(step_of_ppo))
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._patches.undo()

    def _begin(self, agent: Any, minibatch: dict[str, Tensor]) -> None:
        if not self.record:
            self.record["before"] = _copied(agent.get_full_state_weights())
            if hasattr(agent, "discriminator"):  # a schedule changes it
                self.record["grad_penalty"] = agent.discriminator.grad_penalty
            self.record["minibatch"] = {k: v for k, v in minibatch.items() if isinstance(v, Tensor)}


def _gradients(agent: Any) -> list[Tensor | None]:
    learned = agent._learned if isinstance(agent, CommonAgent) else agent.model.parameters()
    return [None if p.grad is None else p.grad.clone() for p in learned]


def _copied(state: dict[str, Any]) -> Any:
    return copy.deepcopy(state)


def joined_first_step(agent: Any, steps: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the first step of one process with the rows of several; the agent is as before it."""

    def joined(key: str) -> dict[str, Tensor]:
        return {name: torch.cat([step[key][name] for step in steps]) for name in steps[0][key]}

    agent.set_train()
    if isinstance(agent, PPOAgent):
        agent.multi_gpu = False
        agent.train_actor_critic(joined("minibatch"))
        return {
            "counted": _copied(agent.get_stats_weights(model_stats=True)),
            "gradients": _gradients(agent),
        }
    if "grad_penalty" in steps[0]:
        (agent.discriminator.grad_penalty,) = {step["grad_penalty"] for step in steps}
    agent.prepare_minibatch(joined("minibatch"))
    counted = _copied(agent.get_stats_weights(model_stats=True))
    gradients, _ = agent.executor.gradients(agent.compute_loss, joined("rows"), agent._learned)
    return {"counted": counted, "gradients": gradients}


def train(folder: Path, name: str, words: tuple[str, ...]) -> None:
    """Train an agent, and write what it has learned."""
    agents: list[Any] = []
    episodes: dict[str, Any] = {}
    remember, share = PPOSafeguards.join_others, PPOSafeguards.share_meters

    def join_others(agent: Any, tensors: list[Tensor]) -> None:
        agents[:] = [agent]
        remember(agent, tensors)

    def share_meters(agent: Any) -> None:
        share(agent)
        episodes["mean_reward"] = agent.game_rewards.get_mean().tolist()
        episodes["episodes"] = int(agent.game_rewards.current_size)

    PPOSafeguards.join_others = join_others  # type: ignore[method-assign]
    PPOSafeguards.share_meters = share_meters  # type: ignore[method-assign]
    try:
        with contextlib.chdir(folder), FirstStep() as first:
            run(compose(words))
    finally:
        PPOSafeguards.join_others = remember  # type: ignore[method-assign]
        PPOSafeguards.share_meters = share  # type: ignore[method-assign]
    before = first.record.pop("before", None)
    content = {"learned": _copied(learned(agents[0])) | episodes, "first": first.record}
    file = folder / f"{name}_{RANK}.pth"
    torch.save(content, file)
    dist.barrier()
    if RANK == 0 and name in WITH_FIRST_STEP:
        other = torch.load(folder / f"{name}_1.pth", weights_only=True)
        agents[0].set_full_state_weights(before)
        content["joined"] = joined_first_step(agents[0], [first.record, other["first"]])
        torch.save(content, file)


def main() -> None:
    folder = Path(sys.argv[1])
    for name, words in AGENTS.items():
        train(folder, name, words)
    (low,) = (folder / "runs").glob("HumanoidASE_*")
    words = (
        *("task=HumanoidHeading", "task.env.motion_file=stand", *TINY_PPO, *TOGETHER),
        f"{CONFIG}.llc_config={low / 'config.yaml'}",
        f"{CONFIG}.llc_checkpoint={next(low.glob('nn/*.pth'))}",
    )
    train(folder, "hrl", words)


if __name__ == "__main__":
    main()
