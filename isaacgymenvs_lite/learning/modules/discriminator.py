"""The style discriminator: normaliser, loss and reward as one object.

Shared by the agents, the players and users of other libraries. The network itself stays inside
the actor-critic network, so that one optimiser and one checkpoint hold everything.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.amp_config import AMPParams
from isaacgymenvs_lite.learning.cpu.parallel import evaluate_in_chunks
from isaacgymenvs_lite.learning.losses import input_gradient
from isaacgymenvs_lite.learning.modules.running_mean_std import RunningMeanStd

# The logistic reward of a sample that certainly is the policy's would be ln(1/0).
_MIN_FAKE_PROBABILITY = 1e-4


class DiscriminatorNetwork(Protocol):
    """What this module needs of a network (AMPBuilder's and its descendants' have it)."""

    def eval_disc(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return logits (n, 1) of normalised AMP observations (n, F).

        A conditional discriminator also wants the latents (n, Z) that they shall express.
        """
        ...

    def get_disc_logit_weights(self) -> Tensor:
        """Return the last layer's weights, flat."""
        ...

    def get_disc_weights(self) -> list[Tensor]:
        """Return all weight matrices, flat."""
        ...


@dataclass(frozen=True)
class AMPObsShape:
    """Of a task's AMP observations.

    Attributes:
        size: F, numbers.
        num_steps: control steps in them, the newest first.
    """

    size: int
    num_steps: int

    @classmethod
    def from_task(cls, env: Any) -> AMPObsShape:
        """Return that of a task; one that does not tell `num_amp_obs_steps` counts as having 1."""
        return cls(env.amp_observation_space.shape[0], getattr(env, "num_amp_obs_steps", 1))


def disc_obs_size(shape: AMPObsShape, params: AMPParams) -> int:
    """Return how many numbers of an AMP observation, the first, discriminator and encoder see.

    Raises:
        ConfigError: `amp_obs_steps` asks for more control steps than there are.
    """
    size, steps = shape.size, shape.num_steps
    if params.amp_obs_steps is None:
        return size
    if params.amp_obs_steps > steps:
        raise ConfigError(
            f"train.params.config.amp_obs_steps={params.amp_obs_steps}: an AMP observation has"
            f" {steps} control steps (task.env.numAMPObsSteps); expected at most so many, or null"
        )
    return size // steps * params.amp_obs_steps


class DiscriminatorParts(NamedTuple):
    """Functions of logits (n, 1) that a discriminator's loss is made of."""

    loss_neg: Callable[[Tensor], Tensor]
    loss_pos: Callable[[Tensor], Tensor]
    accuracies: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


class StyleDiscriminator:
    """Judges whether AMP observations come from the reference motions.

    Args:
        network: holds the discriminator's layers.
        amp_obs_size: numbers that it sees of an AMP observation, the first; see `disc_obs_size`.
        params: weights, kinds of loss and reward.
        disc_reward: `least_squares` or `logistic`, for `params.disc_reward` None.
        device: of the normaliser's statistics.
        preprocess: from raw AMP observations (n, F) to the network's inputs; None: `normalize`.

    Attributes:
        normalizer: running mean and variance (None if `normalize_amp_input` is False). It is no
            part of the model; checkpoints keep it under `amp_input_mean_std`.
    """

    def __init__(
        self,
        network: DiscriminatorNetwork,
        amp_obs_size: int,
        params: AMPParams,
        disc_reward: str,
        device: str | torch.device,
        preprocess: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        self._network = network
        self._params = params
        self._size = amp_obs_size
        self._preprocess = preprocess or self.normalize
        self._reward_kind = params.disc_reward or disc_reward
        self.normalizer: RunningMeanStd | None = None
        if params.normalize_amp_input:
            normalizer = RunningMeanStd((amp_obs_size,), params.amp_input_memory)
            self.normalizer = normalizer.to(device).eval()

    def normalize(self, amp_obs: Tensor, update: bool = False) -> Tensor:
        """Normalise what is seen of AMP observations (n, F); with `update` count it in first."""
        amp_obs = amp_obs[..., : self._size]
        if self.normalizer is None:
            return amp_obs
        if update:
            self.normalizer.count_in(amp_obs)
        with torch.no_grad():
            return self.normalizer(amp_obs)

    def logits(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return logits (..., 1) of raw AMP observations (..., F), without gradients.

        Args:
            amp_obs: raw.
            latents: (..., Z) for a conditional discriminator, none for another.
        """
        return evaluate_in_chunks(
            lambda rows, *given: self._network.eval_disc(self._preprocess(rows), *given),
            amp_obs,
            *latents,
        )

    def reward(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return style rewards (..., 1) of raw AMP observations (..., F); latents as `logits`.

        - logistic (IsaacGymEnvs, ASE): -ln(max(1 - sigmoid(d), 1e-4)) * disc_reward_scale;
        - least_squares (AMP, Peng et al. 2021, eq. 7): max(1 - 0.25 (d - 1)^2, 0) * scale.
        """
        return self.reward_from_logits(self.logits(amp_obs, *latents))

    def reward_from_logits(self, logits: Tensor) -> Tensor:
        """Return style rewards for discriminator logits of any shape; see `reward`."""
        if self._reward_kind == "logistic":
            # 1 - sigmoid(d) = sigmoid(-d), without cancellation for large d
            reward = -torch.log(torch.sigmoid(-logits).clamp(min=_MIN_FAKE_PROBABILITY))
        else:
            reward = (1.0 - 0.25 * (logits - 1.0) ** 2).clamp(min=0.0)
        return reward * self._params.disc_reward_scale

    def loss(
        self,
        agent_logit: Tensor,
        demo_logit: Tensor,
        demo_obs: Tensor,
        demo_gradient: Tensor | None = None,
        parts: DiscriminatorParts | None = None,
    ) -> dict[str, Tensor]:
        """Return the discriminator's loss and what is worth logging.

        prediction + logit regularisation + gradient penalty + weight decay, as IsaacGymEnvs;
        with `disc_loss: least_squares` the prediction loss is AMP's own (eq. 6).

        Args:
            agent_logit: (2K, 1) of the policy's and of replayed observations.
            demo_logit: (K, 1) of reference observations.
            demo_obs: (K, F) normalised, that `demo_logit` came from; with gradients required if
                `demo_gradient` is None.
            demo_gradient: (K, F) gradients of the logits by `demo_obs`, differentiable.
            parts: what an agent computes otherwise.

        Returns:
            `disc_loss` (the weighted sum), `disc_grad_penalty` and `disc_logit_loss` (unweighted),
            `disc_agent_acc`, `disc_demo_acc`, `disc_agent_logit`, `disc_demo_logit`.
        """
        agent_logit, demo_logit = agent_logit.float(), demo_logit.float()
        parts = parts or self.parts()
        # Half the sum of the mean losses on fakes and on demonstrations.
        prediction = 0.5 * (parts.loss_neg(agent_logit) + parts.loss_pos(demo_logit))
        logit_loss = self._network.get_disc_logit_weights().square().sum()
        if demo_gradient is None:
            demo_gradient = input_gradient(demo_logit, demo_obs)
        grad_penalty = demo_gradient.float().square().sum(dim=-1).mean()
        loss = (
            prediction
            + self._params.disc_logit_reg * logit_loss
            + self._params.disc_grad_penalty * grad_penalty
        )
        if self._params.disc_weight_decay != 0.0:
            squares = [weights.square().sum() for weights in self._network.get_disc_weights()]
            loss = loss + self._params.disc_weight_decay * torch.stack(squares).sum()
        agent_acc, demo_acc = parts.accuracies(agent_logit.detach(), demo_logit.detach())
        return {
            "disc_loss": loss,
            "disc_grad_penalty": grad_penalty.detach(),
            "disc_logit_loss": logit_loss.detach(),
            "disc_agent_acc": agent_acc,
            "disc_demo_acc": demo_acc,
            "disc_agent_logit": agent_logit.detach(),
            "disc_demo_logit": demo_logit.detach(),
        }

    def parts(self) -> DiscriminatorParts:
        """Return what `loss` is made of."""
        return DiscriminatorParts(self.loss_neg, self.loss_pos, accuracies)

    def loss_neg(self, logits: Tensor) -> Tensor:
        """Return the mean loss of logits (n, 1) of the policy's observations."""
        if self._params.disc_loss == "least_squares":
            return (logits + 1.0).square().mean()
        return F.binary_cross_entropy_with_logits(logits, torch.zeros_like(logits))

    def loss_pos(self, logits: Tensor) -> Tensor:
        """Return the mean loss of logits (n, 1) of reference observations."""
        if self._params.disc_loss == "least_squares":
            return (logits - 1.0).square().mean()
        return F.binary_cross_entropy_with_logits(logits, torch.ones_like(logits))


def accuracies(agent_logit: Tensor, demo_logit: Tensor) -> tuple[Tensor, Tensor]:
    """Return the shares of the policy's and of reference observations taken for what they are."""
    return (agent_logit < 0.0).float().mean(), (demo_logit > 0.0).float().mean()
