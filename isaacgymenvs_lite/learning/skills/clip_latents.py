"""Latents that the encoder reads from the clips, beside random ones.

With random latents alone a policy must stumble upon every skill by itself, and it settles for the
easiest: standing in many ways. Here some episodes that start in a clip have the latent that the
encoder finds in the clip, so that going on as the clip does earns the encoder's reward at once. The
encoder must spread the clips over the sphere for that. This is between ASE, whose latents are
random, and CALM (Tessler et al. 2023, arXiv 2305.02195), whose latents are all those of clips; the
spreading is the uniformity loss of Wang and Isola 2020 (arXiv 2005.10242).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from isaacgymenvs_lite.learning.skills.latents import sample_latents

# Of the Gaussian potential exp(-t |q - q'|^2), as Wang and Isola.
_UNIFORMITY_T = 2.0


class ClipLatents:
    """Draws latents: those of clips with a chance of `share`, else random ones.

    Args:
        share: 0 to 1.
        latent_dim: Z.
        read: AMP observations (n, F) -> latents (n, Z), the encoder.
        fetch: n -> AMP observations (n, F) of the clips.
        sample: n -> random latents (n, Z); None: uniform on the sphere.
    """

    def __init__(
        self,
        share: float,
        latent_dim: int,
        read: Callable[[Tensor], Tensor],
        fetch: Callable[[int], Tensor],
        sample: Callable[[int], Tensor] | None = None,
    ) -> None:
        self._share = share
        self._latent_dim = latent_dim
        self._read = read
        self._fetch = fetch
        self._sample = sample

    def draw(self, n: int, device: str | torch.device = "cpu") -> Tensor:
        """Return n latents (n, Z), those of clips from anywhere in them."""
        latents, chosen = self.random(n, device)
        if len(chosen) > 0:
            latents[chosen] = self._read(self._fetch(len(chosen)))
        return latents

    def of_starts(self, amp_obs: Tensor) -> Tensor:
        """Return latents (n, Z) of episodes that start with AMP observations (n, F)."""
        latents, chosen = self.random(len(amp_obs), amp_obs.device)
        if len(chosen) > 0:
            latents[chosen] = self._read(amp_obs[chosen])
        return latents

    def random(self, n: int, device: str | torch.device) -> tuple[Tensor, Tensor]:
        """Return random latents (n, Z), and the places (k,) that those of clips shall have."""
        sample = self._sample or (lambda k: sample_latents(k, self._latent_dim, device))
        latents = sample(n).to(device)
        if self._share == 0.0:  # nor shall it use up random numbers
            return latents, torch.empty(0, dtype=torch.int64, device=device)
        chosen = torch.rand(n, device=device) < self._share
        return latents, chosen.nonzero().flatten()


def sample_similar_rows(latents: Tensor, found: Tensor, sharpness: float) -> Tensor:
    """Draw for each of m latents a row of the clips that it may stand for: (m,) places in `found`.

    The nearer, the likelier: by exp(sharpness * z . q), the density of von Mises and Fisher.

    Args:
        latents: (m, Z) unit vectors z.
        found: (n, Z) unit vectors q that the encoder found in n rows of the clips.
        sharpness: 0: any row is as good as any other.
    """
    scores = sharpness * latents @ found.t()
    # The largest of scores with Gumbel noise is a draw by their exponentials.
    noise = torch.empty_like(scores).exponential_().log_()
    return (scores - noise).argmax(dim=-1)


def alignment_loss(found: Tensor, near: Tensor) -> Tensor:
    """Return (n,) |q - q'|^2 of unit vectors (n, Z) that should be one (Wang and Isola, eq. 1)."""
    return (found - near).square().sum(dim=-1)


def uniformity_loss(found: Tensor, others: Tensor) -> Tensor:
    """Return (n,) how near unit vectors (n, Z) are to others (n, Z): exp(-2 |q - q'|^2).

    Wang and Isola 2020, eq. 2, without the logarithm of the mean.
    """
    return torch.exp(-_UNIFORMITY_T * (found - others).square().sum(dim=-1))
