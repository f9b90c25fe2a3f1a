"""The layers of a style discriminator, in whatever network they stand."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from isaacgymenvs_lite.learning.losses import input_gradient

# The last layer starts in U(-1, 1), as IsaacGymEnvs and ASE.
DISC_LOGIT_INIT_SCALE = 1.0


class DiscriminatorLayers:
    """Mixed into a module: what `discriminator.DiscriminatorNetwork` asks for, and more.

    Parameter names are those of IsaacGymEnvs, `_disc_mlp` and `_disc_logits`, so that its
    checkpoints load.
    """

    _disc_mlp: nn.Module
    _disc_logits: nn.Linear

    def _set_disc_layers(self, hidden: nn.Module, width: int) -> None:
        """Take hidden layers with `width` outputs, and add the last one."""
        self._disc_mlp = hidden
        self._disc_logits = nn.Linear(width, 1)
        nn.init.uniform_(self._disc_logits.weight, -DISC_LOGIT_INIT_SCALE, DISC_LOGIT_INIT_SCALE)
        nn.init.zeros_(self._disc_logits.bias)

    def eval_disc(self, amp_obs: Tensor, *latents: Tensor) -> Tensor:
        """Return discriminator logits (n, 1) for normalised AMP observations (n, F).

        Latents are for conditional ones, whose networks override this; here there are none.
        """
        del latents
        return self._disc_logits(self._disc_mlp(amp_obs))

    def eval_disc_with_gradient(self, amp_obs: Tensor, *latents: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits (n, 1) and their gradients by the normalised AMP observations (n, F).

        The gradients can be differentiated by the parameters. Arguments as `eval_disc`.
        """
        with torch.enable_grad():
            # A caller's own gradients stay possible: its rows may want some.
            amp_obs = amp_obs if amp_obs.requires_grad else amp_obs.detach().requires_grad_()
            logits = self.eval_disc(amp_obs, *latents)
        # The backward pass computes as the forward pass did; autocast has no say in it.
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
    """A discriminator by itself, with ReLUs.

    Args:
        amp_obs_size: F, of what it sees of an AMP observation.
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
