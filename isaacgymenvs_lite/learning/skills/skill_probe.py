"""Which clips the skills of a played policy show, and whether the encoder knows them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from isaacgymenvs_lite.evaluation.skill_coverage import ClipMatcher, ClipShares
from isaacgymenvs_lite.learning.modules.skill_encoder import SkillEncoder

# Control steps from one window to the next of an environment.
_STRIDE = 10


@dataclass(frozen=True)
class SkillResult:
    """What the skills of a policy are.

    Attributes:
        clips: of which clips the motion reminds.
        encoder_reward: mean reward of the encoder for the latents that made the motion.
        shuffled_reward: the same for the latents of other environments and times: what the encoder
            pays to motion that says nothing about its latent.
    """

    clips: ClipShares
    encoder_reward: float
    shuffled_reward: float

    def __str__(self) -> str:
        """Return one line for users."""
        return (
            f"{self.clips}; encoder reward {self.encoder_reward:.3f}"
            f" ({self.shuffled_reward:.3f} with shuffled latents)"
        )


class SkillProbe:
    """Collects windows of motion, and the latents that made them, while a policy is played.

    Args:
        env: a task with reference motions (`HumanoidAMP`).
        encoder: of the policy.
    """

    def __init__(self, env: Any, encoder: SkillEncoder) -> None:
        self._env = env
        self._encoder = encoder
        self._history_steps = env.env_cfg.num_amp_obs_steps
        self._windows: list[Tensor] = []
        self._latents: list[Tensor] = []
        self._steps = 0

    def step(self, latents: Tensor, amp_obs: Tensor) -> None:
        """Hear of a control step, before resets.

        Args:
            latents: (N, Z) that the policy acted under.
            amp_obs: (N, F) after it.
        """
        self._steps += 1
        if self._steps % _STRIDE:
            return
        # What lies before the start of an episode was not made by the policy.
        own = self._env.progress_buf >= self._history_steps
        self._windows.append(amp_obs[own.to(amp_obs.device)])
        self._latents.append(latents[own.to(latents.device)])

    def result(self) -> SkillResult | None:
        """Return what was seen; None if no episode was long enough for a window."""
        if not any(len(windows) for windows in self._windows):
            return None
        windows, latents = torch.cat(self._windows), torch.cat(self._latents)
        lib = self._env.motion_lib
        names = [Path(lib.get_motion(i).name).stem for i in range(lib.num_motions())]
        matcher = ClipMatcher(self._env.windows_of_clips(), names)
        others = latents[torch.randperm(len(latents), device=latents.device)]
        return SkillResult(
            clips=matcher.shares(windows),
            encoder_reward=self._encoder.reward(windows, latents).mean().item(),
            shuffled_reward=self._encoder.reward(windows, others).mean().item(),
        )
