"""The style discriminator: its layers, the reward it gives, and its loss.

Peng et al. 2021, "AMP: Adversarial Motion Priors for Stylized Physics-Based Character Control"
(arXiv 2104.02180). In an agent the layers are part of the actor-critic network, so that one
optimiser and one checkpoint hold everything; `StyleNetwork` has them for other libraries' agents.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from isaacgymenvs_lite.env_interface import AMPObsEnv
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.amp_config import AMPParams
from isaacgymenvs_lite.learning.cpu.parallel import evaluate_in_chunks
from isaacgymenvs_lite.learning.modules.running_mean_std import RunningMeanStd

# The last layer starts in U(-1, 1), as IsaacGymEnvs and ASE.
DISC_LOGIT_INIT_SCALE = 1.0
# The logistic reward of a sample that certainly is the policy's would be ln(1/0).
_MIN_FAKE_PROBABILITY = 1e-4

# --- layers ----------------------------------------------------------------------------------


class DiscriminatorLayers:
    """Mixin: the layers of a discriminator, under the names of IsaacGymEnvs' checkpoints."""

    _disc_mlp: nn.Module
    _disc_logits: nn.Linear

    def _set_disc_layers(self, hidden: nn.Module, width: int) -> None:
        """Set the hidden layers, with `width` outputs, and make the last layer."""
        self._disc_mlp = hidden
        self._disc_logits = nn.Linear(width, 1)
        nn.init.uniform_(self._disc_logits.weight, -DISC_LOGIT_INIT_SCALE, DISC_LOGIT_INIT_SCALE)
        nn.init.zeros_(self._disc_logits.bias)

    def eval_disc(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return logits (n, 1) for normalised AMP observations (n, F).

        Only conditional discriminators, which override this, take latents.
        """
        return self._disc_logits(self._disc_mlp(amp_obs))

    def eval_disc_with_gradient(self, amp_obs: Tensor, *latents: Tensor) -> tuple[Tensor, Tensor]:
        """Return `eval_disc` and its gradients (n, F), differentiable by the parameters."""
        with torch.enable_grad():
            # Rows that require gradients keep them: a caller may differentiate by them.
            amp_obs = amp_obs if amp_obs.requires_grad else amp_obs.detach().requires_grad_()
            logits = self.eval_disc(amp_obs, *latents)
        # The backward pass uses the precision of the forward pass, not autocast's.
        with torch.autocast(amp_obs.device.type, enabled=False):
            return logits, input_gradient(logits, amp_obs)

    def disc_parameters(self) -> list[nn.Parameter]:
        """Return the parameters of the discriminator."""
        return [*self._disc_mlp.parameters(), *self._disc_logits.parameters()]

    def get_disc_logit_weights(self) -> Tensor:
        """Return the last layer's weights, flat."""
        return self._disc_logits.weight.flatten()

    def get_disc_weights(self) -> list[Tensor]:
        """Return all weight matrices of the discriminator, flat; no biases."""
        layers = [m for m in self._disc_mlp.modules() if isinstance(m, nn.Linear)]
        return [layer.weight.flatten() for layer in layers] + [self.get_disc_logit_weights()]


def input_gradient(outputs: Tensor, inputs: Tensor) -> Tensor:
    """Return (K, F) the gradients of outputs (K, 1) by inputs (K, F), differentiable themselves.

    For gradient penalties; each output depends on the input of its own row only.
    """
    (gradient,) = torch.autograd.grad(outputs, inputs, torch.ones_like(outputs), create_graph=True)
    return gradient


class StyleNetwork(DiscriminatorLayers, nn.Module):
    """A discriminator in a network of its own, with ReLUs.

    Args:
        amp_obs_size: F, see `disc_obs_size`.
        units: of the hidden layers, at least one.
    """

    def __init__(self, amp_obs_size: int, units: Sequence[int]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        sizes = (amp_obs_size, *units)
        for inputs, outputs in zip(sizes, units, strict=False):
            linear = nn.Linear(inputs, outputs)
            nn.init.zeros_(linear.bias)
            layers += [linear, nn.ReLU()]
        self._set_disc_layers(nn.Sequential(*layers), units[-1])


def eval_discriminator(
    network: Any, agent: Sequence[Tensor], replay: Sequence[Tensor], demo: Sequence[Tensor]
) -> dict[str, Tensor]:
    """Return what the discriminator's loss is computed from.

    Args:
        network: with `DiscriminatorLayers`.
        agent: arguments of `eval_disc` for the newest AMP observations of the policy: normalised
            rows (K, F) and, for a conditional discriminator, latents (K, Z).
        replay: the same for replayed observations of the policy.
        demo: the same for observations of the clips.

    Returns:
        `disc_agent_logit`, `disc_agent_replay_logit`, `disc_demo_logit` (K, 1), and
        `disc_demo_gradient` (K, F), the gradients of the last by the observations.
    """
    fakes = [torch.cat(pair) for pair in zip(agent, replay, strict=True)]
    agent_logit, replay_logit = network.eval_disc(*fakes).split(len(agent[0]))
    demo_logit, gradient = network.eval_disc_with_gradient(*demo)
    return {
        "disc_agent_logit": agent_logit,
        "disc_agent_replay_logit": replay_logit,
        "disc_demo_logit": demo_logit,
        "disc_demo_gradient": gradient,
    }


# --- reward ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class AMPObsShape:
    """The shape of a task's AMP observations.

    Attributes:
        size: F.
        num_steps: control steps in an observation, the newest first.
    """

    size: int
    num_steps: int

    @classmethod
    def from_task(cls, env: AMPObsEnv) -> AMPObsShape:
        """Return a task's shape; without `num_amp_obs_steps` one step is assumed."""
        return cls(env.amp_observation_space.shape[0], getattr(env, "num_amp_obs_steps", 1))


def disc_obs_size(shape: AMPObsShape, params: AMPParams) -> int:
    """Return how many leading entries of an AMP observation discriminator and encoder see.

    Raises:
        ConfigError: `amp_obs_steps` is more than the control steps in an observation.
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


class StyleDiscriminator:
    """Rewards AMP observations that look like the reference motions.

    Args:
        network: with `DiscriminatorLayers`.
        amp_obs_size: leading entries of an AMP observation that it sees; see `disc_obs_size`.
        params: weights, kinds of loss and reward.
        disc_reward: `least_squares` or `logistic`, for `params.disc_reward` None.
        device: of the normaliser's statistics.

    Attributes:
        normalizer: running mean and variance (None if `normalize_amp_input` is False), not part of
            the model.
        grad_penalty: weight of the gradient penalty in the loss.
    """

    def __init__(
        self,
        network: Any,
        amp_obs_size: int,
        params: AMPParams,
        disc_reward: str,
        device: str | torch.device,
    ) -> None:
        self.network = network
        self.params = params
        self.grad_penalty = params.disc_grad_penalty
        self._size = amp_obs_size
        self._device = torch.device(device)
        self._reward_kind = params.disc_reward or disc_reward
        self.normalizer: RunningMeanStd | None = None
        if params.normalize_amp_input:
            normalizer = RunningMeanStd((amp_obs_size,), params.amp_input_memory)
            self.normalizer = normalizer.to(device).eval()

    @property
    def checkpoint_modules(self) -> dict[str, nn.Module]:
        """Modules that a checkpoint holds in addition to the model, by their keys."""
        return {} if self.normalizer is None else {"amp_input_mean_std": self.normalizer}

    def truncate(self, amp_obs: Tensor) -> Tensor:
        """Return what discriminator and encoder see of AMP observations (..., F), on the device."""
        return amp_obs[..., : self._size].to(self._device)

    def normalize(self, amp_obs: Tensor) -> Tensor:
        """Return what is seen of AMP observations (n, F), normalised by the statistics so far."""
        amp_obs = amp_obs[..., : self._size]
        if self.normalizer is None:
            return amp_obs
        with torch.no_grad():
            return self.normalizer(amp_obs)

    def logits(
        self, amp_obs: Tensor, *latents: Tensor, normalize: Callable[[Tensor], Tensor] | None = None
    ) -> Tensor:
        """Return logits (..., 1) of raw AMP observations (..., F), without gradients.

        Args:
            amp_obs: raw.
            latents: (..., Z), for a conditional discriminator only.
            normalize: replaces `self.normalize`.
        """
        inputs = normalize or self.normalize
        return evaluate_in_chunks(
            lambda rows, *given: self.network.eval_disc(inputs(rows), *given), amp_obs, *latents
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
        return reward * self.params.disc_reward_scale


class StyleRewards:
    """The published reward methods of AMP agents and players, as a mixin of both."""

    discriminator: StyleDiscriminator

    def _calc_amp_rewards(self, amp_obs: Tensor) -> dict[str, Tensor]:
        """Return {"disc_rewards": (..., 1)}, the style rewards of raw AMP observations (..., F)."""
        return {"disc_rewards": self._calc_disc_rewards(amp_obs)}

    def _reward_latents(self) -> tuple[Tensor, ...]:
        """Return what the rewards depend on in addition to AMP observations."""
        return ()

    def _calc_disc_rewards(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return style rewards (..., 1) of raw AMP observations (..., F)."""
        return self.discriminator.reward_from_logits(self._eval_disc(amp_obs, *latents))

    def _eval_disc(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return logits (..., 1) of raw AMP observations (..., F), without gradients."""
        return self.discriminator.logits(amp_obs, *latents, normalize=self._preproc_amp_obs)

    def _preproc_amp_obs(self, amp_obs: Tensor) -> Tensor:
        """Return normalised inputs of discriminator and encoder for AMP observations (n, F).

        Several threads call it at the same time: it must not change the object.
        """
        return self.discriminator.normalize(amp_obs)


# --- loss ------------------------------------------------------------------------------------


class StyleLosses(StyleRewards):
    """The published loss methods of AMP agents, as a mixin. Several threads call them."""

    def _disc_loss(
        self,
        disc_agent_logit: Tensor,
        disc_demo_logit: Tensor,
        obs_demo: Tensor,
        disc_demo_gradient: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Return the discriminator's loss and values to log.

        Prediction, logit regularisation, gradient penalty and weight decay, as in IsaacGymEnvs.

        Args:
            disc_agent_logit: (2K, 1) of the policy's and of replayed observations.
            disc_demo_logit: (K, 1) of observations of the clips.
            obs_demo: (K, F) the inputs of `disc_demo_logit`.
            disc_demo_gradient: (K, F) gradients of the logits by `obs_demo`, differentiable; None:
                computed here, as for the published three arguments.

        Returns:
            `disc_loss` (the weighted sum), `disc_grad_penalty` and `disc_logit_loss` (unweighted),
            `disc_agent_acc`, `disc_demo_acc`, `disc_agent_logit`, `disc_demo_logit`.
        """
        network, params = self.discriminator.network, self.discriminator.params
        agent_logit, demo_logit = disc_agent_logit.float(), disc_demo_logit.float()
        prediction = 0.5 * (self._disc_loss_neg(agent_logit) + self._disc_loss_pos(demo_logit))
        logit_loss = network.get_disc_logit_weights().square().sum()
        if disc_demo_gradient is None:
            disc_demo_gradient = input_gradient(demo_logit, obs_demo)
        grad_penalty = disc_demo_gradient.float().square().sum(dim=-1).mean()
        loss = (
            prediction
            + params.disc_logit_reg * logit_loss
            + self.discriminator.grad_penalty * grad_penalty
        )
        if params.disc_weight_decay != 0.0:
            squares = [weights.square().sum() for weights in network.get_disc_weights()]
            loss = loss + params.disc_weight_decay * torch.stack(squares).sum()
        agent_acc, demo_acc = self._compute_disc_acc(agent_logit.detach(), demo_logit.detach())
        return {
            "disc_loss": loss,
            "disc_grad_penalty": grad_penalty.detach(),
            "disc_logit_loss": logit_loss.detach(),
            "disc_agent_acc": agent_acc,
            "disc_demo_acc": demo_acc,
            "disc_agent_logit": agent_logit.detach(),
            "disc_demo_logit": demo_logit.detach(),
        }

    def _disc_loss_neg(self, disc_logits: Tensor) -> Tensor:
        """Return the mean loss of logits (n, 1) of the policy's observations.

        Cross-entropy, or with `disc_loss: least_squares` the AMP paper's own loss (eq. 6).
        """
        if self.discriminator.params.disc_loss == "least_squares":
            return (disc_logits + 1.0).square().mean()
        return F.binary_cross_entropy_with_logits(disc_logits, torch.zeros_like(disc_logits))

    def _disc_loss_pos(self, disc_logits: Tensor) -> Tensor:
        """Return the mean loss of logits (n, 1) of demonstrations; see `_disc_loss_neg`."""
        if self.discriminator.params.disc_loss == "least_squares":
            return (disc_logits - 1.0).square().mean()
        return F.binary_cross_entropy_with_logits(disc_logits, torch.ones_like(disc_logits))

    def _compute_disc_acc(
        self, disc_agent_logit: Tensor, disc_demo_logit: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the shares of fakes and of demonstrations that are classified correctly."""
        return (disc_agent_logit < 0.0).float().mean(), (disc_demo_logit > 0.0).float().mean()
