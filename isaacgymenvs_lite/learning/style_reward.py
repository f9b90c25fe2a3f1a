"""AMP's style reward for agents of other libraries: reward the rollout, then learn from it.

    style = StyleReward(task, read_style_params())
    rewards = style.total(rewards, infos["amp_obs"])    # in each step
    style.update()                                      # after each rollout

The discriminator is the AMP agent's (`discriminator.StyleDiscriminator`); what differs is that it
has a network and an optimiser of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from isaacgymenvs_lite.config.train_files import load_train_file
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.amp_config import AMPParams, read_agent_params
from isaacgymenvs_lite.learning.modules.discriminator import (
    AMPObsShape,
    StyleDiscriminator,
    disc_obs_size,
)
from isaacgymenvs_lite.learning.modules.discriminator_layers import StyleNetwork
from isaacgymenvs_lite.learning.replay_buffer import ReplayBuffer

_LEARNING_RATE = 5e-5


def read_style_params(train_file: str = "HumanoidAMPPPO", **changes: Any) -> AMPParams:
    """Return the AMP keys of a train file.

    Args:
        train_file: path or name.
        changes: keys to set otherwise, `task_reward_w=0.5`.

    Raises:
        ConfigError: there is no such file, or a key that cannot be used.
    """
    config = load_train_file(train_file)["params"]["config"]
    return read_agent_params({**config, **changes}, AMPParams)


class StyleReward:
    """Rewards motion that looks like a task's clips; see the module docstring.

    Args:
        task: with reference motions, HumanoidAMP for example.
        params: weights, kinds of loss and reward, sizes of buffers.
        units: of the discriminator's hidden layers.
        device: where it learns.

    Attributes:
        discriminator: normaliser, loss and reward.
        network: the layers; with the normaliser all there is to save.

    Raises:
        ConfigError: a task without reference motions.
    """

    def __init__(
        self,
        task: Any,
        params: AMPParams,
        units: Sequence[int] = (512, 256),
        device: str | torch.device = "cpu",
    ) -> None:
        if not hasattr(task, "fetch_amp_obs_demo"):
            raise ConfigError(
                f"StyleReward: {type(task).__name__} has no reference motions; expected a task such"
                " as HumanoidAMP"
            )
        self._task, self._params, self._device = task, params, torch.device(device)
        self._size = disc_obs_size(AMPObsShape.from_task(task), params)
        self.network = StyleNetwork(self._size, units).to(device)
        self.discriminator = StyleDiscriminator(
            self.network, self._size, params, "logistic", device
        )
        rate = params.disc_learning_rate or _LEARNING_RATE
        self._optimizer = torch.optim.Adam(self.network.parameters(), lr=rate)
        self._replay = ReplayBuffer(params.amp_replay_buffer_size, device)
        self._demos = ReplayBuffer(params.amp_obs_demo_buffer_size, device)
        for _ in range(math.ceil(params.amp_obs_demo_buffer_size / params.amp_batch_size)):
            self._store_demos()
        self._rollout: list[Tensor] = []

    def total(self, task_rewards: Tensor, amp_obs: Tensor) -> Tensor:
        """Return task_reward_w * task + disc_reward_w * style (N,), and remember the motion.

        Args:
            task_rewards: (N,).
            amp_obs: (N, F), `infos["amp_obs"]` of the same step.
        """
        seen = amp_obs[..., : self._size].to(self._device)
        self._rollout.append(seen)
        style = self.discriminator.reward(seen).squeeze(-1).to(task_rewards.device)
        return self._params.task_reward_w * task_rewards + self._params.disc_reward_w * style

    def update(self, epochs: int = 1) -> dict[str, float]:
        """Learn to tell the motion since the last update from the clips'.

        Args:
            epochs: how often each row of that motion is seen.

        Returns:
            means of what `StyleDiscriminator.loss` tells: `disc_agent_acc`, `disc_demo_acc`, ...;
            nothing if nothing was rewarded.
        """
        if not self._rollout:
            return {}
        fakes = torch.cat(self._rollout)
        self._rollout = []
        self._store_demos()
        told: list[dict[str, Tensor]] = []
        size = min(self._params.amp_minibatch_size, len(fakes))
        for _ in range(epochs):
            order = torch.randperm(len(fakes), device=fakes.device)
            # Rows that fill no minibatch wait for another order.
            for rows in order[: len(fakes) // size * size].split(size):
                told.append(self._learn(fakes[rows]))
        self._replay.store_some({"amp_obs": fakes}, self._params.amp_replay_keep_prob)
        return {name: _mean([one[name] for one in told]) for name in told[0]}

    def _learn(self, fakes: Tensor) -> dict[str, Tensor]:
        """Make a gradient step with fakes (n, F), as many replayed ones and demonstrations."""
        replayed = fakes
        if self._replay.get_total_count() > 0:
            replayed = self._replay.sample(len(fakes))["amp_obs"]
        demos = self._demos.sample(len(fakes))["amp_obs"]
        kinds = (fakes, replayed, demos)
        inputs = [self._with_noise(self.discriminator.normalize(rows)) for rows in kinds]
        demo_logit, demo_gradient = self.network.eval_disc_with_gradient(inputs[2])
        info = self.discriminator.loss(
            self.network.eval_disc(torch.cat(inputs[:2])), demo_logit, inputs[2], demo_gradient
        )
        self._optimizer.zero_grad()
        info["disc_loss"].backward()
        self._optimizer.step()
        # After the step: a first minibatch is normalised as it was when it was rewarded.
        self.discriminator.normalize(torch.cat(kinds), update=True)
        return {name: value.detach() for name, value in info.items()}

    def _with_noise(self, inputs: Tensor) -> Tensor:
        if self._params.disc_input_noise == 0.0:
            return inputs
        return inputs + self._params.disc_input_noise * torch.randn_like(inputs)

    def _store_demos(self) -> None:
        demos = self._task.fetch_amp_obs_demo(self._params.amp_batch_size)
        self._demos.store({"amp_obs": demos[..., : self._size].to(self._device)})


def _mean(values: Sequence[Tensor]) -> float:
    return float(torch.stack([value.mean() for value in values]).mean())
