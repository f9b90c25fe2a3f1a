"""Measures which clips the skills of a policy show, and whether the encoder recognises them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from isaacgymenvs_lite.env_interface import ClipWindowsEnv
from isaacgymenvs_lite.evaluation.skill_coverage import ClipMatcher, ClipShares
from isaacgymenvs_lite.learning.modules.skill_encoder import SkillEncoder

# Control steps from one window to the next of an environment.
_STRIDE = 10


@dataclass(frozen=True)
class SkillResult:
    """The skills of a policy.

    Attributes:
        clips: which clips the motion resembles.
        encoder_reward: mean reward of the encoder for the latents that the policy acted under.
        shuffled_reward: the same for the latents of other environments and times: the encoder's
            reward for motion that does not depend on its latent.
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
    """Collects windows of motion, and their latents, while a policy is played.

    Args:
        env: the task.
        encoder: of the policy.
    """

    def __init__(self, env: ClipWindowsEnv, encoder: SkillEncoder) -> None:
        self._env = env
        self._encoder = encoder
        self._history_steps = env.num_amp_obs_steps
        self._windows: list[Tensor] = []
        self._latents: list[Tensor] = []
        self._steps = 0

    def step(self, latents: Tensor, amp_obs: Tensor) -> None:
        """Store a control step, before resets.

        Args:
            latents: (N, Z) that the policy acted under.
            amp_obs: (N, F) after it.
        """
        self._steps += 1
        if self._steps % _STRIDE:
            return
        # Frames from before the start of an episode are not the policy's.
        own = self._env.progress_buf >= self._history_steps
        self._windows.append(amp_obs[own.to(amp_obs.device)])
        self._latents.append(latents[own.to(latents.device)])

    def result(self) -> SkillResult | None:
        """Return the skills; None if no episode was long enough for a window."""
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
