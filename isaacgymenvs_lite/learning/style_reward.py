"""AMP's style reward, for agents of other reinforcement learning libraries.

    style = StyleReward(task, read_style_params())
    rewards = style.total(rewards, infos["amp_obs"])    # in each step
    style.update()                                      # after each rollout

The discriminator is trained like in the AMP agent, but with a separate network and optimiser, and
with a constant weight `disc_grad_penalty` of the gradient penalty.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from isaacgymenvs_lite.config.train_files import read_train_file
from isaacgymenvs_lite.env_interface import AMPEnv, require
from isaacgymenvs_lite.learning.amp_config import AMPParams, read_agent_params
from isaacgymenvs_lite.learning.modules.discriminator import (
    AMPObsShape,
    StyleDiscriminator,
    StyleLosses,
    StyleNetwork,
    disc_obs_size,
    eval_discriminator,
)
from isaacgymenvs_lite.learning.replay_buffer import ReplayBuffer

_LEARNING_RATE = 5e-5


def read_style_params(train_file: str = "HumanoidAMPPPO", **changes: Any) -> AMPParams:
    """Return the AMP keys of a train file (its name or path); `changes` replace some values."""
    config = read_train_file(train_file)["params"]["config"]
    return read_agent_params({**config, **changes}, AMPParams)


class StyleReward(StyleLosses):
    """Computes rewards for motion that looks like a task's clips; see the module docstring.

    `units` are the sizes of the discriminator's hidden layers.

    Attributes:
        discriminator: normaliser and reward of the discriminator.
        network: layers of the discriminator. Save them together with the normaliser.

    Raises:
        ConfigError: the task has no reference motions.
    """

    def __init__(
        self,
        task: AMPEnv,
        params: AMPParams,
        units: Sequence[int] = (512, 256),
        device: str | torch.device = "cpu",
    ) -> None:
        self._task, self._params = require(task, AMPEnv, "StyleReward"), params
        size = disc_obs_size(AMPObsShape.from_task(task), params)
        self.network = StyleNetwork(size, units).to(device)
        self.discriminator = StyleDiscriminator(self.network, size, params, "logistic", device)
        rate = params.disc_learning_rate or _LEARNING_RATE
        self._optimizer = torch.optim.Adam(self.network.parameters(), lr=rate)
        self._demos = ReplayBuffer(params.amp_obs_demo_buffer_size, device)
        self._replay = ReplayBuffer(params.amp_replay_buffer_size, device)
        for _ in range(math.ceil(params.amp_obs_demo_buffer_size / params.amp_batch_size)):
            self._store_demos()
        self._rollout: list[Tensor] = []

    def total(self, task_rewards: Tensor, amp_obs: Tensor) -> Tensor:
        """Return total rewards (N,) for task rewards (N,) and AMP observations (N, F) of a step.

        A total reward is task_reward_w * task + disc_reward_w * style. The AMP observations are
        stored for `update`.
        """
        amp_obs = self.discriminator.truncate(amp_obs)
        self._rollout.append(amp_obs)
        style = self.discriminator.reward(amp_obs).squeeze(-1).to(task_rewards.device)
        return self._params.task_reward_w * task_rewards + self._params.disc_reward_w * style

    def update(self, epochs: int = 1) -> dict[str, float]:
        """Train the discriminator on the stored AMP observations, and return means to log."""
        if not self._rollout:
            return {}
        fakes = torch.cat(self._rollout)
        self._rollout = []
        self._store_demos()
        infos: list[dict[str, Tensor]] = []
        size = min(self._params.amp_minibatch_size, len(fakes))
        for _ in range(epochs):
            order = torch.randperm(len(fakes), device=fakes.device)
            # Rows after the last whole minibatch are left out; each epoch has a new random order.
            for rows in order[: len(fakes) // size * size].split(size):
                infos.append(self._learn(fakes[rows]))
        self._replay.store_some({"amp_obs": fakes}, self._params.amp_replay_keep_prob)
        return {
            name: float(torch.stack([info[name].mean() for info in infos]).mean())
            for name in infos[0]
        }

    def _learn(self, fakes: Tensor) -> dict[str, Tensor]:
        """Take a gradient step on n AMP observations of policy, replay buffer and clips each."""
        has_older = self._replay.get_total_count() > 0
        replayed = self._replay.sample(len(fakes))["amp_obs"] if has_older else fakes
        kinds = (fakes, replayed, self._demos.sample(len(fakes))["amp_obs"])
        agent, replay, demo = (self._inputs(rows) for rows in kinds)
        outputs = eval_discriminator(self.network, (agent,), (replay,), (demo,))
        info = self._disc_loss(
            torch.cat((outputs["disc_agent_logit"], outputs["disc_agent_replay_logit"])),
            outputs["disc_demo_logit"],
            demo,
            outputs["disc_demo_gradient"],
        )
        self._optimizer.zero_grad()
        info["disc_loss"].backward()
        self._optimizer.step()
        # The statistics are updated after the minibatch, which is normalised like its rewards were.
        if self.discriminator.normalizer is not None:
            self.discriminator.normalizer.count_in(torch.cat(kinds))
        return {name: value.detach() for name, value in info.items()}

    def _inputs(self, amp_obs: Tensor) -> Tensor:
        inputs = self.discriminator.normalize(amp_obs)
        if self._params.disc_input_noise == 0.0:
            return inputs
        return inputs + self._params.disc_input_noise * torch.randn_like(inputs)

    def _store_demos(self) -> None:
        demos = self._task.fetch_amp_obs_demo(self._params.amp_batch_size)
        self._demos.store({"amp_obs": self.discriminator.truncate(demos)})
