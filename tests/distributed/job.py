"""What torchrun starts for the tests: `-m tests.distributed.job FOLDER NAME...`.

Trains the named agents, one after another, and writes what each process has learned to
FOLDER/<name>_<rank>.pth.
"""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.learning.common_agent import CommonAgent
from isaacgymenvs_lite.learning.safeguards import PPOSafeguards
from isaacgymenvs_lite.runner import run
from tests.tiny import CONFIG, TINY_AMP, TINY_PPO, TINY_STYLE

ADAPTIVE = f"{CONFIG}.lr_schedule=adaptive"
TOGETHER = ("multi_gpu=True", "num_envs=16", "max_iterations=3")
SHORT = "task.env.episodeLength=5"
AGENTS = {
    "ppo": ("task=Ant", *TINY_PPO, ADAPTIVE, SHORT, *TOGETHER),
    "asymmetric": ("task=AnymalTerrain", "train=AnymalTerrainPPO", *TINY_PPO, *TOGETHER),
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
RANK = int(os.environ["RANK"])


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
        "mean_reward": agent.game_rewards.get_mean().tolist(),
        "episodes": agent.game_rewards.current_size,
    }


class FirstStep:
    """Records the first gradient step of agents with a loss of their own."""

    def __init__(self) -> None:
        self.record: dict[str, Any] = {}
        self._prepare = CommonAgent.prepare_minibatch
        self._step = CommonAgent.trancate_gradients_and_step

    def __enter__(self) -> FirstStep:
        record, prepare, step = self.record, self._prepare, self._step

        def prepare_minibatch(agent: Any, minibatch: dict[str, Tensor]) -> dict[str, Tensor]:
            if not record:
                record["before"] = agent.get_full_state_weights()
                record["before"] = torch.load(_copied(record["before"]), weights_only=True)
                record["minibatch"] = {k: v for k, v in minibatch.items() if v is not None}
            rows = prepare(agent, minibatch)
            record.setdefault("rows", rows)
            return rows

        def trancate_gradients_and_step(agent: Any) -> None:
            own = [None if p.grad is None else p.grad.clone() for p in agent._learned]
            step(agent)
            if "gradients" not in record:
                record["own_gradients"] = own
                record["gradients"] = [p.grad for p in agent._learned]
                record["after"] = torch.load(
                    _copied(agent.get_full_state_weights()), weights_only=True
                )

        CommonAgent.prepare_minibatch = prepare_minibatch  # type: ignore[method-assign]
        CommonAgent.trancate_gradients_and_step = trancate_gradients_and_step
        return self

    def __exit__(self, *exc_info: object) -> None:
        CommonAgent.prepare_minibatch = self._prepare  # type: ignore[method-assign]
        CommonAgent.trancate_gradients_and_step = self._step


def _copied(state: dict[str, Any]) -> Any:
    import io

    stream = io.BytesIO()
    torch.save(state, stream)
    stream.seek(0)
    return stream


def train(folder: Path, name: str, words: tuple[str, ...]) -> None:
    """Train an agent, and write what it has learned."""
    agents: list[Any] = []
    remember = PPOSafeguards.join_others

    def join_others(agent: Any, tensors: list[Tensor]) -> None:
        agents[:] = [agent]
        remember(agent, tensors)

    PPOSafeguards.join_others = join_others  # type: ignore[method-assign]
    try:
        with contextlib.chdir(folder), FirstStep() as first:
            run(compose(words))
    finally:
        PPOSafeguards.join_others = remember  # type: ignore[method-assign]
    content = {"learned": learned(agents[0]), "first": first.record}
    torch.save(content, folder / f"{name}_{RANK}.pth")


def main() -> None:
    folder = Path(sys.argv[1])
    for name in sys.argv[2:]:
        train(folder, name, AGENTS[name])
    if "gen_amp" in sys.argv[2:]:
        (low,) = (folder / "runs").glob("HumanoidASE_*")
        words = (
            *("task=HumanoidHeading", "task.env.motion_file=stand", *TINY_PPO, *TOGETHER),
            f"{CONFIG}.llc_config={low / 'config.yaml'}",
            f"{CONFIG}.llc_checkpoint={next(low.glob('nn/*.pth'))}",
        )
        train(folder, "hrl", words)


if __name__ == "__main__":
    main()
