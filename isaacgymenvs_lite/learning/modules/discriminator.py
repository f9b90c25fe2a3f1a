"""The style discriminator: layers, reward and loss.

Peng et al. 2021, "AMP: Adversarial Motion Priors for Stylized Physics-Based Character Control"
(arXiv 2104.02180). In an agent, the discriminator's layers belong to the actor-critic network.
Policy, critic and discriminator share one optimiser and one checkpoint.
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

# The last layer is initialised with U(-1, 1), as in IsaacGymEnvs and ASE.
DISC_LOGIT_INIT_SCALE = 1.0
# The logistic reward is -ln(p); this least p keeps it finite.
_MIN_FAKE_PROBABILITY = 1e-4

# --- layers ----------------------------------------------------------------------------------


class DiscriminatorLayers:
    """Mixin with the discriminator's layers, which have the names of IsaacGymEnvs' checkpoints."""

    _disc_mlp: nn.Module
    _disc_logits: nn.Linear

    def _set_disc_layers(self, hidden: nn.Module, width: int) -> None:
        """Set the hidden layers, which have `width` outputs, and create the last layer."""
        self._disc_mlp = hidden
        self._disc_logits = nn.Linear(width, 1)
        nn.init.uniform_(self._disc_logits.weight, -DISC_LOGIT_INIT_SCALE, DISC_LOGIT_INIT_SCALE)
        nn.init.zeros_(self._disc_logits.bias)

    def eval_disc(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return logits (n, 1) of normalised AMP observations (n, F).

        Some subclasses also need latents.
        """
        return self._disc_logits(self._disc_mlp(amp_obs))

    def eval_disc_with_gradient(self, amp_obs: Tensor, *latents: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits (n, 1) and their gradients (n, F) with respect to the AMP observations.

        The gradients are differentiable.
        """
        with torch.enable_grad():
            # The caller may need gradients with respect to `amp_obs`, which then already requires
            # them.
            amp_obs = amp_obs if amp_obs.requires_grad else amp_obs.detach().requires_grad_()
            logits = self.eval_disc(amp_obs, *latents)
        # Autocast is off here: a backward pass uses the precision of its forward pass.
        with torch.autocast(amp_obs.device.type, enabled=False):
            return logits, input_gradient(logits, amp_obs)

    def disc_parameters(self) -> list[nn.Parameter]:
        """Return the discriminator's parameters."""
        return [*self._disc_mlp.parameters(), *self._disc_logits.parameters()]

    def get_disc_logit_weights(self) -> Tensor:
        """Return the last layer's weights, flat."""
        return self._disc_logits.weight.flatten()

    def get_disc_weights(self) -> list[Tensor]:
        """Return the discriminator's weight matrices, flat, without biases."""
        layers = [m for m in self._disc_mlp.modules() if isinstance(m, nn.Linear)]
        return [layer.weight.flatten() for layer in layers] + [self.get_disc_logit_weights()]


def input_gradient(outputs: Tensor, inputs: Tensor) -> Tensor:
    """Return the gradient (K, F) of each output (K, 1) with respect to its input row (K, F)."""
    (gradient,) = torch.autograd.grad(outputs, inputs, torch.ones_like(outputs), create_graph=True)
    return gradient


class StyleNetwork(DiscriminatorLayers, nn.Module):
    """A separate discriminator network; its hidden layers have the sizes `units` and ReLUs."""

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
    """Return the discriminator's logits for AMP observations of policy, replay buffer and clips.

    Args:
        network: a network with `DiscriminatorLayers`.
        agent: normalised AMP observations (K, F) of the policy and, for a conditional
            discriminator, latents (K, Z).
        replay: AMP observations and latents from the replay buffer.
        demo: AMP observations and latents of the clips.

    Returns:
        `disc_agent_logit`, `disc_agent_replay_logit`, `disc_demo_logit` (K, 1), and
        `disc_demo_gradient` (K, F), the gradients of `disc_demo_logit` with respect to the AMP
        observations of the clips.
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
    """The size of a task's AMP observations, and the number of control steps that they hold."""

    size: int
    num_steps: int

    @classmethod
    def from_task(cls, env: AMPObsEnv) -> AMPObsShape:
        """Return the shape of a task's AMP observations; by default they hold one control step."""
        return cls(env.amp_observation_space.shape[0], getattr(env, "num_amp_obs_steps", 1))


def disc_obs_size(shape: AMPObsShape, params: AMPParams) -> int:
    """Return how many leading entries of an AMP observation the discriminator sees."""
    size, steps = shape.size, shape.num_steps
    if params.amp_obs_steps is None:
        return size
    if params.amp_obs_steps > steps:
        raise ConfigError(
            f"train.params.config.amp_obs_steps={params.amp_obs_steps}: expected null or at most"
            f" {steps}, the control steps in an AMP observation (task.env.numAMPObsSteps)"
        )
    return size // steps * params.amp_obs_steps


class StyleDiscriminator:
    """A discriminator with a reward for AMP observations that look like the reference motions.

    `disc_reward` (`least_squares` or `logistic`) is used if `params.disc_reward` is None.

    Attributes:
        normalizer: running mean and variance of AMP observations (no part of the model), or None if
            `normalize_amp_input` is False.
        grad_penalty: current weight of the gradient penalty in the loss.
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
        """The modules that a checkpoint stores in addition to the model, by their keys."""
        return {} if self.normalizer is None else {"amp_input_mean_std": self.normalizer}

    def truncate(self, amp_obs: Tensor) -> Tensor:
        """Return the entries of AMP observations (..., F) that networks see, on the device."""
        return amp_obs[..., : self._size].to(self._device)

    def normalize(self, amp_obs: Tensor) -> Tensor:
        """Truncate AMP observations (n, F), and normalise them with the current statistics."""
        amp_obs = amp_obs[..., : self._size]
        if self.normalizer is None:
            return amp_obs
        with torch.no_grad():
            return self.normalizer(amp_obs)

    def logits(
        self, amp_obs: Tensor, *latents: Tensor, normalize: Callable[[Tensor], Tensor] | None = None
    ) -> Tensor:
        """Return logits (..., 1) of AMP observations (..., F) that are not normalised yet."""
        inputs = normalize or self.normalize
        return evaluate_in_chunks(
            lambda rows, *given: self.network.eval_disc(inputs(rows), *given), amp_obs, *latents
        )

    def reward(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return style rewards (..., 1) of raw AMP observations (..., F) and latents (..., Z).

        - logistic (IsaacGymEnvs, ASE): -ln(max(1 - sigmoid(d), 1e-4)) * disc_reward_scale;
        - least_squares (AMP, Peng et al. 2021, eq. 7): max(1 - 0.25 (d - 1)^2, 0) * scale.
        """
        return self.reward_from_logits(self.logits(amp_obs, *latents))

    def reward_from_logits(self, logits: Tensor) -> Tensor:
        """Return the style reward of each discriminator logit; the formulas are in `reward`."""
        if self._reward_kind == "logistic":
            # sigmoid(-d) is 1 - sigmoid(d) without cancellation for large d.
            reward = -torch.log(torch.sigmoid(-logits).clamp(min=_MIN_FAKE_PROBABILITY))
        else:
            reward = (1.0 - 0.25 * (logits - 1.0) ** 2).clamp(min=0.0)
        return reward * self.params.disc_reward_scale


class StyleRewards:
    """Mixin with the published reward methods of AMP agents and players."""

    discriminator: StyleDiscriminator

    def _calc_amp_rewards(self, amp_obs: Tensor) -> dict[str, Tensor]:
        """Return {"disc_rewards": (..., 1)} of raw AMP observations (..., F)."""
        return {"disc_rewards": self._calc_disc_rewards(amp_obs)}

    def _reward_latents(self) -> tuple[Tensor, ...]:
        """Return the latents that the reward function needs in addition to AMP observations."""
        return ()

    def _calc_disc_rewards(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return style rewards (..., 1) of raw AMP observations (..., F)."""
        return self.discriminator.reward_from_logits(self._eval_disc(amp_obs, *latents))

    def _eval_disc(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return logits (..., 1) of raw AMP observations (..., F), without gradients."""
        return self.discriminator.logits(amp_obs, *latents, normalize=self._preproc_amp_obs)

    def _preproc_amp_obs(self, amp_obs: Tensor) -> Tensor:
        """Return normalised AMP observations (n, F). Several threads call this method at once."""
        return self.discriminator.normalize(amp_obs)


# --- loss ------------------------------------------------------------------------------------


class StyleLosses(StyleRewards):
    """Mixin with the published loss methods of AMP agents, which several threads call."""

    def _disc_loss(
        self,
        disc_agent_logit: Tensor,
        disc_demo_logit: Tensor,
        obs_demo: Tensor,
        disc_demo_gradient: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Return the discriminator's loss and values to log, as in IsaacGymEnvs.

        Args:
            disc_agent_logit: (2K, 1) logits of observations from the policy and from the replay
                buffer.
            disc_demo_logit: (K, 1) logits of observations of the clips.
            obs_demo: (K, F) AMP observations of the clips, for which `disc_demo_logit` was
                computed.
            disc_demo_gradient: (K, F) differentiable gradients of `disc_demo_logit` with respect to
                `obs_demo`. If `disc_demo_gradient` is None, this method computes the gradients.

        Returns:
            `disc_loss` (weighted sum of prediction, logit regularisation, gradient penalty and
            weight decay), `disc_grad_penalty` and `disc_logit_loss` (unweighted), accuracies and
            logits.
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
        """Return cross-entropy, or the AMP paper's loss (eq. 6), of logits (n, 1) of the policy."""
        if self.discriminator.params.disc_loss == "least_squares":
            return (disc_logits + 1.0).square().mean()
        return F.binary_cross_entropy_with_logits(disc_logits, torch.zeros_like(disc_logits))

    def _disc_loss_pos(self, disc_logits: Tensor) -> Tensor:
        """Return cross-entropy, or the AMP paper's loss (eq. 6), of logits (n, 1) of the clips."""
        if self.discriminator.params.disc_loss == "least_squares":
            return (disc_logits - 1.0).square().mean()
        return F.binary_cross_entropy_with_logits(disc_logits, torch.ones_like(disc_logits))

    def _compute_disc_acc(
        self, disc_agent_logit: Tensor, disc_demo_logit: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the accuracies for AMP observations of the policy and of the clips."""
        return (disc_agent_logit < 0.0).float().mean(), (disc_demo_logit > 0.0).float().mean()
