"""The style discriminator: its layers, the reward it gives, and how it is trained.

Peng et al. 2021, "AMP: Adversarial Motion Priors for Stylized Physics-Based Character Control"
(arXiv 2104.02180). In an agent the layers are part of the actor-critic network, so that one
optimiser and one checkpoint hold everything; `StyleNetwork` has them for other libraries' agents.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from isaacgymenvs_lite.env_interface import AMPObsEnv
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.amp_config import AMPParams
from isaacgymenvs_lite.learning.cpu.parallel import evaluate_in_chunks
from isaacgymenvs_lite.learning.losses import input_gradient
from isaacgymenvs_lite.learning.modules.running_mean_std import RunningMeanStd
from isaacgymenvs_lite.learning.replay_buffer import ReplayBuffer

# The last layer starts in U(-1, 1), as IsaacGymEnvs and ASE.
DISC_LOGIT_INIT_SCALE = 1.0
# The logistic reward of a sample that certainly is the policy's would be ln(1/0).
_MIN_FAKE_PROBABILITY = 1e-4
# Shares of the time limit that training episodes last, with exploration noise.
_BEGINS_TO_STAY_UP, _STAYS_UP = 0.3, 0.6

# --- layers ----------------------------------------------------------------------------------


class DiscriminatorLayers:
    """The layers of a discriminator, as a mixin of the module that holds them.

    Parameter names are those of IsaacGymEnvs, `_disc_mlp` and `_disc_logits`, so that its
    checkpoints load.
    """

    _disc_mlp: nn.Module
    _disc_logits: nn.Linear

    def _set_disc_layers(self, hidden: nn.Module, width: int) -> None:
        """Set the hidden layers, which have `width` outputs, and make the last one."""
        self._disc_mlp = hidden
        self._disc_logits = nn.Linear(width, 1)
        nn.init.uniform_(self._disc_logits.weight, -DISC_LOGIT_INIT_SCALE, DISC_LOGIT_INIT_SCALE)
        nn.init.zeros_(self._disc_logits.bias)

    def eval_disc(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return discriminator logits (n, 1) for normalised AMP observations (n, F).

        Conditional discriminators override this; here there are no latents.
        """
        return self._disc_logits(self._disc_mlp(amp_obs))

    def eval_disc_with_gradient(self, amp_obs: Tensor, *latents: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits (n, 1) and their gradients by the normalised AMP observations (n, F).

        The gradients can be differentiated by the parameters. Arguments as `eval_disc`.
        """
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
    network: Any,
    agent: Sequence[Tensor],
    replay: Sequence[Tensor],
    demo: Sequence[Tensor],
) -> dict[str, Tensor]:
    """Return what the discriminator's loss is computed from.

    Args:
        network: with `DiscriminatorLayers`.
        agent: the arguments of `eval_disc` for the policy's newest AMP observations: normalised
            rows (K, F) and, for a conditional discriminator, latents (K, Z).
        replay: the same for replayed observations of the policy.
        demo: the same for reference observations.

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


class DiscriminatorNetwork(Protocol):
    """What `StyleDiscriminator` and its trainer need of a network with `DiscriminatorLayers`."""

    def eval_disc(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return logits (n, 1) of normalised AMP observations (n, F).

        A conditional discriminator takes latents (n, Z), too: the skills they should show.
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
    """The shape of a task's AMP observations.

    Attributes:
        size: F, numbers.
        num_steps: control steps in them, the newest first.
    """

    size: int
    num_steps: int

    @classmethod
    def from_task(cls, env: AMPObsEnv) -> AMPObsShape:
        """Return the shape in a task; without `num_amp_obs_steps` one step is assumed."""
        return cls(env.amp_observation_space.shape[0], getattr(env, "num_amp_obs_steps", 1))


def disc_obs_size(shape: AMPObsShape, params: AMPParams) -> int:
    """Return how many numbers of an AMP observation, the first, discriminator and encoder see.

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
        network: holds the discriminator's layers.
        amp_obs_size: numbers that it sees of an AMP observation, the first; see `disc_obs_size`.
        params: weights, kinds of loss and reward.
        disc_reward: `least_squares` or `logistic`, for `params.disc_reward` None.
        device: of the normaliser's statistics.
        preprocess: from raw AMP observations (n, F) to the network's inputs; None: `normalize`.

    Attributes:
        normalizer: running mean and variance (None if `normalize_amp_input` is False), not part of
            the model.
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
        self._device = torch.device(device)
        self._preprocess = preprocess or self.normalize
        self._reward_kind = params.disc_reward or disc_reward
        self.normalizer: RunningMeanStd | None = None
        if params.normalize_amp_input:
            normalizer = RunningMeanStd((amp_obs_size,), params.amp_input_memory)
            self.normalizer = normalizer.to(device).eval()

    @property
    def checkpoint_modules(self) -> dict[str, nn.Module]:
        """Modules that a checkpoint holds beside the model, by their keys there."""
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

    def total_reward(self, task_rewards: Tensor, style_rewards: Tensor) -> Tensor:
        """Return task_reward_w * task + disc_reward_w * style, in the shape of both."""
        return (
            self._params.task_reward_w * task_rewards + self._params.disc_reward_w * style_rewards
        )


class StyleRewards:
    """The published reward methods of AMP agents and players, as a mixin of both."""

    discriminator: StyleDiscriminator

    def _calc_amp_rewards(self, amp_obs: Tensor) -> dict[str, Tensor]:
        """Return {"disc_rewards": (..., 1)}, the style rewards of raw AMP observations (..., F)."""
        return {"disc_rewards": self._calc_disc_rewards(amp_obs)}

    def _reward_latents(self) -> tuple[Tensor, ...]:
        """Return what the rewards depend on beside AMP observations."""
        return ()

    def _calc_disc_rewards(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return style rewards (..., 1) of raw AMP observations (..., F)."""
        return self.discriminator.reward_from_logits(self._eval_disc(amp_obs, *latents))

    def _eval_disc(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return logits (..., 1) of raw AMP observations (..., F), without gradients."""
        return self.discriminator.logits(amp_obs, *latents)

    def _preproc_amp_obs(self, amp_obs: Tensor) -> Tensor:
        """Return the inputs of discriminator and encoder: raw AMP observations (n, F), normalised.

        Several threads call it at the same time: it must not change the object. An agent updates
        the statistics elsewhere (`_normalizer_inputs`).
        """
        return self.discriminator.normalize(amp_obs)


# --- training --------------------------------------------------------------------------------


class LossFunctions(NamedTuple):
    """Functions of logits (n, 1) that a discriminator's loss is made of."""

    loss_neg: Callable[[Tensor], Tensor]
    loss_pos: Callable[[Tensor], Tensor]
    accuracies: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def scheduled_grad_penalty(first: float, last: float, progress: float) -> float:
    """Return the weight of the gradient penalty, from `first` down to `last` by a constant factor.

    Args:
        first: at progress 0.
        last: at progress 1; one above `first` counts as `first`.
        progress: 0 to 1; see `upright_progress`.
    """
    return float(first ** (1.0 - progress) * min(first, last) ** progress)


def upright_progress(episode_share: float) -> float:
    """Return how far a policy has learned to stay up, 0 to 1.

    Args:
        episode_share: mean length of training episodes, as a share of the time limit. Exploration
            makes policies fall that would not fall without: 0.3 is where they begin to stay up, and
            0.6 is enough.
    """
    first, last = _BEGINS_TO_STAY_UP, _STAYS_UP
    return min(max((episode_share - first) / (last - first), 0.0), 1.0)


class DiscriminatorTrainer(StyleDiscriminator):
    """Trains a style discriminator: demonstrations, replayed rows, normaliser and loss.

    `AMPAgent` and `style_reward.StyleReward` share it; each of them takes the gradient steps. For
    every minibatch

    1. take the policy's rows, and as many from `sample_replay` and `sample_demos`;
    2. `normalize` them, and add `sample_noise` to them;
    3. compute `eval_discriminator` and `loss`;
    4. `update_normalizer` with the raw rows (an agent does this first, for all its normalisers).

    Once per rollout `store_demos` and `store_replay`.

    Attributes:
        demo_buffer: reference observations; `make_buffers` makes both.
        replay_buffer: past observations of the policy.
        grad_penalty: weight of the gradient penalty; None: `disc_grad_penalty`.
    """

    demo_buffer: ReplayBuffer
    replay_buffer: ReplayBuffer
    grad_penalty: float | None = None

    def make_buffers(self) -> None:
        """Make both buffers, empty."""
        self.demo_buffer = ReplayBuffer(self._params.amp_obs_demo_buffer_size, self._device)
        self.replay_buffer = ReplayBuffer(self._params.amp_replay_buffer_size, self._device)

    def fill_demo_buffer(self, store_batch: Callable[[], None]) -> None:
        """Fill the buffer of demonstrations.

        Args:
            store_batch: calls `store_demos` with `amp_batch_size` rows.
        """
        size = self.demo_buffer.get_buffer_size()
        for _ in range(math.ceil(size / self._params.amp_batch_size)):
            store_batch()

    def store_demos(self, demos: dict[str, Tensor]) -> None:
        """Store reference observations: {name: (n, F)}, raw, the same names in every call."""
        self.demo_buffer.store({name: self.truncate(rows) for name, rows in demos.items()})

    def sample_demos(self, n: int) -> dict[str, Tensor]:
        """Return n rows of what `store_demos` stored."""
        return self.demo_buffer.sample(n)

    def store_replay(self, rows: dict[str, Tensor]) -> None:
        """Store rows of the policy; once the buffer is full, a share amp_replay_keep_prob of them.

        Args:
            rows: {name: (n, ...)}, `amp_obs` as `truncate` returns them.
        """
        self.replay_buffer.store_some(rows, self._params.amp_replay_keep_prob)

    def sample_replay(self, fakes: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return as many past rows of the policy; before the first `store_replay` these ones."""
        if self.replay_buffer.get_total_count() == 0:
            return fakes
        return self.replay_buffer.sample(len(fakes["amp_obs"]))

    def sample_noise(self, amp_obs: Tensor) -> Tensor | None:
        """Return noise to add to normalised AMP observations (n, F); None if there is none."""
        if self._params.disc_input_noise == 0.0:
            return None
        return self._params.disc_input_noise * torch.randn_like(amp_obs)

    def update_normalizer(self, amp_obs: Tensor) -> None:
        """Update the statistics by AMP observations (n, F)."""
        if self.normalizer is not None:
            self.normalizer.count_in(amp_obs[..., : self._size])

    def loss(
        self,
        agent_logit: Tensor,
        demo_logit: Tensor,
        demo_obs: Tensor,
        demo_gradient: Tensor | None = None,
        functions: LossFunctions | None = None,
    ) -> dict[str, Tensor]:
        """Return the discriminator's loss and values to log.

        prediction + logit regularisation + gradient penalty + weight decay, as IsaacGymEnvs;
        with `disc_loss: least_squares` the prediction loss is AMP's own (eq. 6).

        Args:
            agent_logit: (2K, 1) of the policy's and of replayed observations.
            demo_logit: (K, 1) of reference observations.
            demo_obs: (K, F) the inputs of `demo_logit`; they require gradients if `demo_gradient`
                is None.
            demo_gradient: (K, F) gradients of the logits by `demo_obs`, differentiable.
            functions: None: this class' own.

        Returns:
            `disc_loss` (the weighted sum), `disc_grad_penalty` and `disc_logit_loss` (unweighted),
            `disc_agent_acc`, `disc_demo_acc`, `disc_agent_logit`, `disc_demo_logit`.
        """
        agent_logit, demo_logit = agent_logit.float(), demo_logit.float()
        functions = functions or self.loss_functions
        # Half the sum of the mean losses on fakes and on demonstrations.
        prediction = 0.5 * (functions.loss_neg(agent_logit) + functions.loss_pos(demo_logit))
        logit_loss = self._network.get_disc_logit_weights().square().sum()
        if demo_gradient is None:
            demo_gradient = input_gradient(demo_logit, demo_obs)
        grad_penalty = demo_gradient.float().square().sum(dim=-1).mean()
        weight = self._params.disc_grad_penalty if self.grad_penalty is None else self.grad_penalty
        loss = prediction + self._params.disc_logit_reg * logit_loss + weight * grad_penalty
        if self._params.disc_weight_decay != 0.0:
            squares = [weights.square().sum() for weights in self._network.get_disc_weights()]
            loss = loss + self._params.disc_weight_decay * torch.stack(squares).sum()
        agent_acc, demo_acc = functions.accuracies(agent_logit.detach(), demo_logit.detach())
        return {
            "disc_loss": loss,
            "disc_grad_penalty": grad_penalty.detach(),
            "disc_logit_loss": logit_loss.detach(),
            "disc_agent_acc": agent_acc,
            "disc_demo_acc": demo_acc,
            "disc_agent_logit": agent_logit.detach(),
            "disc_demo_logit": demo_logit.detach(),
        }

    @property
    def loss_functions(self) -> LossFunctions:
        """What `loss` is made of."""
        return LossFunctions(self.loss_neg, self.loss_pos, accuracies)

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
    """Return the shares of the policy's and of reference observations that are classified right."""
    return (agent_logit < 0.0).float().mean(), (demo_logit > 0.0).float().mean()
