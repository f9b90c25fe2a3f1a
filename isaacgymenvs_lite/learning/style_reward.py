"""AMP's style reward for agents of other libraries: reward the rollout, then learn from it.

    style = StyleReward(task, read_style_params())
    rewards = style.total(rewards, infos["amp_obs"])    # in each step
    style.update()                                      # after each rollout

The discriminator is trained as the AMP agent's, with a network and an optimiser of its own. Its
gradient penalty is constant, `disc_grad_penalty`: only an agent has the length of its episodes.
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
    """Return the AMP keys of a train file.

    Args:
        train_file: path or name.
        changes: keys to set otherwise, `task_reward_w=0.5`.

    Raises:
        ConfigError: there is no such file, or a key that cannot be used.
    """
    config = read_train_file(train_file)["params"]["config"]
    return read_agent_params({**config, **changes}, AMPParams)


class StyleReward(StyleLosses):
    """Rewards motion that looks like a task's clips; see the module docstring.

    Args:
        task: with reference motions, HumanoidAMP for example.
        params: weights, kinds of loss and reward, sizes of buffers.
        units: of the discriminator's hidden layers.
        device: where it learns.

    Attributes:
        discriminator: its normaliser and reward.
        network: the layers; with the normaliser all there is to save.

    Raises:
        ConfigError: a task without reference motions.
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
        """Return task_reward_w * task + disc_reward_w * style (N,), and keep the motion to learn.

        Args:
            task_rewards: (N,).
            amp_obs: (N, F), `infos["amp_obs"]` of the same step.
        """
        amp_obs = self.discriminator.truncate(amp_obs)
        self._rollout.append(amp_obs)
        style = self.discriminator.reward(amp_obs).squeeze(-1).to(task_rewards.device)
        return self._params.task_reward_w * task_rewards + self._params.disc_reward_w * style

    def update(self, epochs: int = 1) -> dict[str, float]:
        """Train the discriminator on the motion since the last update, `epochs` times.

        Returns:
            Means of what `_disc_loss` returns; nothing if nothing was rewarded.
        """
        if not self._rollout:
            return {}
        fakes = torch.cat(self._rollout)
        self._rollout = []
        self._store_demos()
        infos: list[dict[str, Tensor]] = []
        size = min(self._params.amp_minibatch_size, len(fakes))
        for _ in range(epochs):
            order = torch.randperm(len(fakes), device=fakes.device)
            # Rows that fill no minibatch wait for another order.
            for rows in order[: len(fakes) // size * size].split(size):
                infos.append(self._learn(fakes[rows]))
        self._replay.store_some({"amp_obs": fakes}, self._params.amp_replay_keep_prob)
        return {name: _mean([info[name] for info in infos]) for name in infos[0]}

    def _learn(self, fakes: Tensor) -> dict[str, Tensor]:
        """Make a gradient step with fakes (n, F), as many replayed ones and demonstrations."""
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
        # After the step: a first minibatch is normalised as it was when it was rewarded.
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


def _mean(values: Sequence[Tensor]) -> float:
    return float(torch.stack([value.mean() for value in values]).mean())
