"""A warm start: the policy's mean action learns to follow the clips before the first epoch.

An untrained policy needs millions of frames to learn the drive targets that follow a clip. The
drive targets can be computed, and behaviour cloning teaches them to the actor in some seconds, from
noisy states of the clips. The policy only learns in the later training to keep its balance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

from isaacgymenvs_lite.env_interface import TrackingDemo
from isaacgymenvs_lite.learning.modules.running_mean_std import RunningMeanStd

NUM_SAMPLES = 20_000
"""Number of states drawn from the clips for behaviour cloning."""
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
    """Train the actor to predict the actions in `demo`; return the root mean squared error.

    Actor and critic must share no layers; critic and learned standard deviations do not change.
    Observations get noise of `noise` standard deviations, and the normaliser counts the noisy
    observations.
    """
    std = noise * demo.obs.std(dim=0)
    if normalizer is not None:
        normalizer.count_in(demo.obs + std * torch.randn_like(demo.obs))
        # A least variance keeps nearly constant inputs from being clipped as soon as a robot falls.
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
    """Minimise `loss` by Adam with a linearly falling learning rate, and return its last value.

    `loss` draws a new batch in each call. Gradients of other parameters do not change.
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
    """Return the parameters that the mean action depends on, in the order of `parameters()`."""
    layers = (network.actor_mlp, network.mu)
    return [parameter for layer in layers for parameter in layer.parameters()]
