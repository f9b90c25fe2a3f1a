"""Skill latents (unit vectors that select a skill of the policy), and when they change.

Peng et al. 2022, "ASE: Large-Scale Reusable Adversarial Skill Embeddings" (arXiv 2205.01906).
A policy with only random latents, as in ASE, must find every skill by exploration, and often
learns only to stand in many ways. Some episodes start in a pose of a clip, and `ClipLatents` gives
them the latent that the encoder infers from the clip. A policy that then continues the clip earns
the encoder's reward. CALM (Tessler et al. 2023, arXiv 2305.02195) infers all latents from clips.
"""

from __future__ import annotations

from collections.abc import Callable

import gymnasium
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.utils.state import Stateful


def sample_latents(n: int, latent_dim: int, device: str | torch.device = "cpu") -> Tensor:
    """Return n unit vectors (n, latent_dim), uniform on the sphere."""
    return F.normalize(torch.randn(n, latent_dim, device=device), dim=-1)


def latent_space(latent_dim: int) -> gymnasium.spaces.Box:
    """Return the action space of a policy that chooses latents."""
    return gymnasium.spaces.Box(-1.0, 1.0, (latent_dim,), np.float32)


class LatentSchedule(Stateful):
    """The latents of N environments, each kept for `steps_min` to `steps_max` - 1 control steps.

    `draw` returns n unit vectors (n, Z), which are random by default.

    Attributes:
        latents: (N, Z) current latents; a change creates a new tensor.
        change_at: (N,) control step of each episode after which the latent changes.
    """

    stored = ("latents", "change_at")

    def __init__(
        self,
        num_envs: int,
        latent_dim: int,
        steps_min: int,
        steps_max: int,
        device: str | torch.device = "cpu",
        draw: Callable[[int], Tensor] | None = None,
    ) -> None:
        if not 1 <= steps_min < steps_max:
            raise ConfigError(
                f"train.params.config.latent_steps_min={steps_min},"
                f" latent_steps_max={steps_max}: expected 1 <= min < max"
            )
        self._steps = (steps_min, steps_max)
        self._device = device
        self._draw = draw or (lambda n: sample_latents(n, latent_dim, device))
        self.latents = sample_latents(num_envs, latent_dim, device)
        self.change_at = self._draw_steps(num_envs)

    def restart(self, env_ids: Tensor, latents: Tensor | None = None) -> None:
        """Start new episodes in environments (n,) with `latents` (n, Z), or with drawn ones."""
        if len(env_ids) == 0:
            return
        self._renew(env_ids, self._draw(len(env_ids)) if latents is None else latents)
        self.change_at[env_ids] = self._draw_steps(len(env_ids))

    def is_over(self, progress: Tensor) -> Tensor:
        """Return (N,) bool, whether each latent changes after `progress` (N,) control steps."""
        return self.change_at <= progress

    def advance(self, progress: Tensor) -> Tensor:
        """Replace latents that change after `progress` (N,) steps; return the environments (n,)."""
        env_ids = self.is_over(progress).nonzero().flatten()
        if len(env_ids) > 0:
            self._renew(env_ids, self._draw(len(env_ids)))
            self.change_at[env_ids] += self._draw_steps(len(env_ids))
        return env_ids

    def _renew(self, env_ids: Tensor, latents: Tensor) -> None:
        # A new tensor is made, because the rollout still refers to the old one.
        self.latents = self.latents.clone()
        self.latents[env_ids] = latents

    def _draw_steps(self, n: int) -> Tensor:
        return torch.randint(*self._steps, (n,), device=self._device)


class ClipLatents:
    """Draws latents that are inferred from a clip with probability `share`, and otherwise random.

    `read` is the encoder, a function from AMP observations (n, F) to latents (n, Z). `fetch(n)`
    returns n AMP observations of the clips. `sample(n)` returns n random latents; by default they
    are uniform on the sphere.
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
        """Return latents (n, Z), random or inferred from random AMP observations of the clips."""
        latents, chosen = self.random(n, device)
        if len(chosen) > 0:
            latents[chosen] = self._read(self._fetch(len(chosen)))
        return latents

    def for_starts(self, amp_obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return latents (n, Z) for episodes that start with AMP observations (n, F).

        The second result (k,) contains the indices of the latents that the encoder inferred.
        """
        latents, chosen = self.random(len(amp_obs), amp_obs.device)
        if len(chosen) > 0:
            latents[chosen] = self._read(amp_obs[chosen])
        return latents, chosen

    def random(self, n: int, device: str | torch.device) -> tuple[Tensor, Tensor]:
        """Return random latents (n, Z), and indices (k,) of the ones to replace by clip latents."""
        sample = self._sample or (lambda k: sample_latents(k, self._latent_dim, device))
        latents = sample(n).to(device)
        if self._share == 0.0:  # The random generator is not advanced.
            return latents, torch.empty(0, dtype=torch.int64, device=device)
        chosen = torch.rand(n, device=device) < self._share
        return latents, chosen.nonzero().flatten()


def sample_similar_rows(latents: Tensor, found: Tensor, sharpness: float) -> Tensor:
    """Draw a row of the clips with a similar latent for each z (m, Z); return m indices of `found`.

    `found` (n, Z) are latents q that the encoder inferred from n rows of the clips. The probability
    of a row is proportional to exp(sharpness * z . q) (von Mises and Fisher).
    """
    scores = sharpness * latents @ found.t()
    # The row with the largest sum of score and Gumbel noise is a sample with probability ~
    # exp(score).
    noise = torch.empty_like(scores).exponential_().log_()
    return (scores - noise).argmax(dim=-1)


class EvaluationLatents:
    """Computes the latents of a played or evaluated task; call the object before each policy step.

    If `interpolate` is True, each latent moves gradually along the sphere to the next latent.
    """

    def __init__(self, schedule: LatentSchedule, interpolate: bool = False) -> None:
        self._schedule = schedule
        self._interpolate = interpolate
        self._before = schedule.latents
        self._since = torch.zeros(len(schedule.latents), device=schedule.latents.device)

    def __call__(self, progress: Tensor) -> Tensor:
        """Return latents (N, Z) after `progress` (N,) control steps of the episodes."""
        schedule = self._schedule
        is_new = progress == 0
        changes = is_new | schedule.is_over(progress)
        target = schedule.latents
        schedule.restart(is_new.nonzero().flatten())
        schedule.advance(progress)
        if not self._interpolate:
            return schedule.latents
        # The first arc of an episode starts at its first latent, and every other arc where the last
        # arc ended.
        start = torch.where(is_new.unsqueeze(-1), schedule.latents, target)
        self._before = torch.where(changes.unsqueeze(-1), start, self._before)
        self._since = torch.where(changes, progress.to(self._since.dtype), self._since)
        share = (progress - self._since) / (schedule.change_at - self._since)
        return interpolate_on_sphere(self._before, schedule.latents, share)


def interpolate_on_sphere(start: Tensor, end: Tensor, share: Tensor) -> Tensor:
    """Return unit vectors (n, Z) on the great circles from `start` (n, Z) to `end` (n, Z).

    `share` (n,) is the fraction of the angle: 0 gives `start`, 1 gives `end`. `start` and `end`
    must not be opposite vectors.
    """
    cosine = (start * end).sum(dim=-1, keepdim=True).clamp(-1.0, 1.0)
    angle, share = cosine.acos(), share.unsqueeze(-1)
    point = torch.sin((1.0 - share) * angle) * start + torch.sin(share * angle) * end
    # The division by sin(angle) is avoided where `start` and `end` coincide.
    return torch.where(angle < 1e-4, start, F.normalize(point, dim=-1))
