"""A warm start: before the first epoch the mean action learns to follow the reference motions.

A new policy acts at random, and spends its first millions of frames on what can be computed: drives
follow a clip if their targets lead it. The actor learns these actions in some seconds by regression
(behaviour cloning), from states of the clips with noise on them. It does not keep its balance yet;
that is what the training is for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

from isaacgymenvs_lite.env_interface import TrackingDemo
from isaacgymenvs_lite.learning.modules.running_mean_std import RunningMeanStd

NUM_SAMPLES = 20_000
"""States of the clips that are learned from."""
_ROWS = 256
_FIRST_RATE, _LAST_RATE = 1e-3, 1e-5
_LEAST_STD = 0.1


def clone_actions(
    model: Any,
    normalizer: RunningMeanStd | None,
    demo: TrackingDemo,
    num_steps: int,
    noise: float,
    latents: Tensor | None = None,
) -> float:
    """Teach the actor the actions of a demonstration; return the root mean squared error.

    The critic and a noise that is learned stay as they are.

    Args:
        model: rl_games' model, with an actor that shares no layers.
        normalizer: of its observations, which counts the noisy observations in; None without one.
        demo: on the model's device; `obs` as the model receives them.
        num_steps: of gradient descent.
        noise: standard deviation of the noise on observations, as a share of theirs.
        latents: (n, Z) of the demonstration, for an actor that receives them.
    """
    std = noise * demo.obs.std(dim=0)
    if normalizer is not None:
        normalizer.count_in(demo.obs + std * torch.randn_like(demo.obs))
        # Entries that hardly differ in the clips would all be at the limit when a robot falls.
        normalizer.running_var.clamp_(min=_LEAST_STD**2)
    network = model.a2c_network
    model.eval()

    def loss() -> Tensor:
        rows = torch.randint(len(demo.obs), (_ROWS,), device=demo.obs.device)
        obs = demo.obs[rows]
        with torch.no_grad():
            inputs = model.norm_obs(obs + std * torch.randn_like(obs))
        of_latents = () if latents is None else (latents[rows],)
        means, _ = network.eval_actor(inputs, *of_latents)
        return (means - demo.actions[rows]).square().mean()

    return descend(loss, actor_parameters(network), num_steps) ** 0.5


def descend(
    loss: Callable[[], Tensor], parameters: Iterable[nn.Parameter], num_steps: int
) -> float:
    """Take steps of Adam, whose size falls linearly; return the last step's loss.

    Args:
        loss: returns the loss of a batch of its own choice.
        parameters: learn; the gradients of all others stay as they are.
        num_steps: at least 1.
    """
    learned = list(parameters)
    adam = torch.optim.Adam(learned, lr=_FIRST_RATE, fused=True)
    rates = torch.optim.lr_scheduler.LinearLR(adam, 1.0, _LAST_RATE / _FIRST_RATE, num_steps)
    value = torch.zeros(())
    for _ in range(num_steps):
        value = loss()
        gradients = torch.autograd.grad(value, learned)
        for parameter, gradient in zip(learned, gradients, strict=True):
            parameter.grad = gradient
        adam.step()
        rates.step()
    adam.zero_grad()
    return float(value.detach())


def actor_parameters(network: Any) -> list[nn.Parameter]:
    """Return the parameters of the mean action, in the order of `parameters()`."""
    layers = (network.actor_mlp, network.mu)
    return [parameter for layer in layers for parameter in layer.parameters()]
