"""Players of policies that receive skill latents."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from isaacgymenvs_lite.env_interface import ClipWindowsEnv, SkillEnv, fits, require
from isaacgymenvs_lite.errors import ConfigError, one_line
from isaacgymenvs_lite.evaluation.skill_coverage import ClipMatcher, ClipShares
from isaacgymenvs_lite.evaluation.skill_pace import ClipPaces, PaceProbe
from isaacgymenvs_lite.learning.amp_config import AMPParams, GenAMPParams
from isaacgymenvs_lite.learning.amp_players import AMPPlayerContinuous
from isaacgymenvs_lite.learning.gen_amp import make_evaluation_schedule
from isaacgymenvs_lite.learning.modules.skill_encoder import SkillEncoder, SkillRewards
from isaacgymenvs_lite.learning.published_names import ReadOnly
from isaacgymenvs_lite.learning.skills.latents import EvaluationLatents
from isaacgymenvs_lite.motion.motion_lib import MotionLib

log = logging.getLogger(__name__)
# Number of control steps between two sampled motion windows (sequences of poses) of an environment.
_STRIDE = 10


class GenAMPPlayerContinuous(SkillRewards, AMPPlayerContinuous):
    """The player of `gen_amp` and `ase`.

    The key `latent` of `train.params.config.player` (`latent=` for `train.py`) has five forms.
    `random`, the default, draws new latents at resets and after random numbers of steps, as
    training does. `interpolate` moves gradually from each latent to the next. A .npy file (K,
    latent_dim) fixes the latents: environment i always uses row i mod K. The name of a clip fixes
    the mean latent that the encoder infers from this clip. `clips` does so for all K clips:
    environment i uses clip i mod K.

    Attributes:
        encoder: infers latents from motion.
        current_latents: (N, Z) latents in the last control step.
        skills: the skills that `run` measured, or None before `run`, if all episodes were too
            short, or if the task is no `ClipWindowsEnv`.
        paces: the paces that `run` measured, or None before `run`, if no clip's latent is fixed, or
            if no episode was longer than two seconds.

    Raises:
        ConfigError: `latent` has none of these forms, or the file's latents cannot be used.
    """

    _latent_dim = ReadOnly("_amp.latent_dim")
    _latent_steps_min = ReadOnly("_amp.latent_steps_min")
    _latent_steps_max = ReadOnly("_amp.latent_steps_max")
    _enc_reward_scale = ReadOnly("_amp.enc_reward_scale")
    _ase_latents = ReadOnly("current_latents", "_latents_of")

    is_latent_conditioned = True
    params_class: ClassVar[type[AMPParams]] = GenAMPParams
    _amp: GenAMPParams

    def __init__(self, params: dict[str, Any]) -> None:
        super().__init__(params)
        self.latent_dim = self._amp.latent_dim
        self.encoder = SkillEncoder(
            self.model.a2c_network, lambda amp_obs: self._preproc_amp_obs(amp_obs), self._amp
        )
        self._pace_probe: PaceProbe | None = None
        self.paces: ClipPaces | None = None
        latent = str(self.player_config.get("latent") or "random")
        self._latents = self._latents_of(latent)
        self._probe: SkillProbe | None = None
        if fits(self.env, ClipWindowsEnv):
            self._probe = SkillProbe(self.env, self.encoder)
        self.skills: SkillResult | None = None

    def _build_net_config(self) -> dict[str, Any]:
        return {**super()._build_net_config(), **self._sizes_of_inputs(self.env)}

    def _latents_of(self, latent: str) -> Callable[[Tensor], Tensor]:
        """Return a function from the control step of each episode (N,) to latents (N, Z)."""
        task = require(self.env, SkillEnv, "a policy with skill latents")
        if latent in ("random", "interpolate"):
            schedule = make_evaluation_schedule(self._amp, task, self.encoder, self.device)
            return EvaluationLatents(schedule, interpolate=latent == "interpolate")
        of_env = torch.arange(self.env.num_envs, device=self.device)
        if latent.endswith(".npy"):
            rows = read_latents(Path(latent), self._amp.latent_dim).to(self.device)
            fixed = rows[of_env % len(rows)]
            return lambda progress: fixed
        return self._latents_of_clips(latent)

    def _latents_of_clips(self, latent: str) -> Callable[[Tensor], Tensor]:
        """Return a function to the mean latents of one clip, or of all clips."""
        task = require(self.env, ClipWindowsEnv, f"latent={latent}")
        names = clip_names(task.motion_lib)
        if latent != "clips" and latent not in names:
            raise ConfigError(
                f"latent={latent}: expected random, interpolate, a .npy file, clips, or one of the"
                f" clips {', '.join(names)}"
            )
        chosen = range(len(names)) if latent == "clips" else [names.index(latent)]
        of_env = torch.tensor(chosen)[torch.arange(self.env.num_envs) % len(chosen)]
        self._pace_probe = PaceProbe(self.env, names, of_env)

        @cache  # The encoder's weights are restored after this object is made.
        def latents() -> Tensor:
            windows = (rows.to(self.device) for rows in task.windows_of_clips())
            means = torch.stack([self.encoder.read(rows).mean(0) for rows in windows])
            return F.normalize(means, dim=-1)[of_env.to(self.device)]

        return lambda progress: latents()

    def _policy_inputs(self) -> dict[str, Tensor]:
        self.current_latents = self._latents(self.env.progress_buf.to(self.device))
        return {**super()._policy_inputs(), "amp_latents": self.current_latents}

    def _disc_latents(self) -> tuple[Tensor, ...]:
        return (self.current_latents,) if self._disc_is_conditional else ()

    def _reward_latents(self) -> tuple[Tensor, ...]:
        return (self.current_latents,)

    def _measure(self) -> None:
        """Play, measure the result, and log how much of the motion resembles each clip."""
        super()._measure()
        self.skills = self._probe.result() if self._probe is not None else None
        if self.skills is not None:
            log.info("skills: %s", self.skills)
        if self._pace_probe is not None:
            self.paces = self._pace_probe.result()
            log.info("%s", self.paces or "no pace: no episode was longer than two seconds")

    def _post_step(self, info: dict[str, Any]) -> None:
        super()._post_step(info)
        if self._pace_probe is not None:
            self._pace_probe.step()
        if self._probe is not None:
            self._probe.step(self.current_latents, info["amp_obs"].to(self.device))


def clip_names(lib: MotionLib) -> list[str]:
    """Return the clips' file names without folders and endings."""
    return [Path(lib.get_motion(i).name).stem for i in range(lib.num_motions())]


def read_latents(file: Path, latent_dim: int) -> Tensor:
    """Read K latents (K, latent_dim) from a .npy file, and scale them to length 1."""
    try:
        array = np.load(file, allow_pickle=False)
        rows = torch.from_numpy(np.atleast_2d(array).astype(np.float32))
    except Exception as error:  # For a file of another kind, the reader may raise any exception.
        raise ConfigError(
            f"latent={file}: {one_line(error)}; expected random, interpolate or a .npy file"
        ) from error
    if rows.ndim != 2 or rows.shape[1] != latent_dim or len(rows) == 0:
        raise ConfigError(
            f"latent={file}: the array has shape {array.shape}, expected (K, {latent_dim}) as the"
            f" policy's latents have dimension {latent_dim}"
        )
    lengths = rows.norm(dim=-1)
    if not bool(((lengths > 0.0) & lengths.isfinite()).all()):
        raise ConfigError(f"latent={file}: a row is zero or not finite; it has no direction")
    return F.normalize(rows, dim=-1)


@dataclass(frozen=True)
class SkillResult:
    """The skills of a policy.

    Attributes:
        clips: share of the policy's motion that resembles each clip.
        encoder_reward: mean encoder reward of the motion for the policy's own latents.
        shuffled_reward: mean encoder reward of the motion for latents of other environments and
            times. `encoder_reward` and `shuffled_reward` are equal if the motion does not depend on
            the latent.
    """

    clips: ClipShares
    encoder_reward: float
    shuffled_reward: float

    def __str__(self) -> str:
        """Return a line of text for users."""
        return (
            f"{self.clips}; encoder reward {self.encoder_reward:.3f}"
            f" ({self.shuffled_reward:.3f} with shuffled latents)"
        )


class SkillProbe:
    """Collects motion windows (sequences of poses) and their latents while a policy is played."""

    def __init__(self, env: ClipWindowsEnv, encoder: SkillEncoder) -> None:
        self._env = env
        self._encoder = encoder
        self._history_steps = env.num_amp_obs_steps
        self._windows: list[Tensor] = []
        self._latents: list[Tensor] = []
        self._steps = 0

    def step(self, latents: Tensor, amp_obs: Tensor) -> None:
        """Store latents (N, Z) and resulting AMP observations (N, F); call this before resets."""
        self._steps += 1
        if self._steps % _STRIDE:
            return
        # Frames before the start of an episode do not come from the policy.
        own = self._env.progress_buf >= self._history_steps
        self._windows.append(amp_obs[own.to(amp_obs.device)])
        self._latents.append(latents[own.to(latents.device)])

    def result(self) -> SkillResult | None:
        """Return the measured skills, or None if all episodes were shorter than a motion window."""
        if not any(len(windows) for windows in self._windows):
            return None
        windows, latents = torch.cat(self._windows), torch.cat(self._latents)
        lib = self._env.motion_lib
        matcher = ClipMatcher(self._env.windows_of_clips(), clip_names(lib))
        others = latents[torch.randperm(len(latents), device=latents.device)]
        return SkillResult(
            clips=matcher.shares(windows),
            encoder_reward=self._encoder.reward(windows, latents).mean().item(),
            shuffled_reward=self._encoder.reward(windows, others).mean().item(),
        )
