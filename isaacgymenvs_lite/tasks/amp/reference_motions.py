"""Provides a task's clips as demonstrations for a discriminator and as starts of episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import CharacterState, HumanoidAMPConfig
from isaacgymenvs_lite.utils.state import Stateful

_BIN_S = 0.1
_UPDATE = 0.02  # weight of a new episode in the failure rate of its bin
_WINDOWS_AT_A_TIME = 256  # larger batches exceed the CPU's cache
_STARTS_AT_A_TIME = 1024
_FAILS_SOON_S = 1.5  # a leap and its landing take this time
_LEAST_LEFT_S = 0.5  # least duration of an episode that ends with its clip


class ReferenceMotions:
    """Provides states and AMP observations of a task's clips at given or random times.

    An AMP observation, or window, is a series of `num_steps` control steps, newest first, flattened
    to F values. `features` computes one control step of a window from character states. Clips are
    drawn by weight. The end times of `motion_share` of the windows are drawn in proportion to the
    motion in the clip, and all others uniformly.
    """

    def __init__(
        self,
        lib: MotionLib,
        features: Callable[[CharacterState], Tensor],
        num_steps: int,
        control_dt_s: float,
        motion_share: float = 0.0,
    ) -> None:
        self.lib = lib
        self._features = features
        self._dt_s = control_dt_s
        self._motion_share = motion_share
        self._steps = torch.arange(num_steps, device=lib.device)
        self._history_s = control_dt_s * (num_steps - 1)

    def states(self, motion_ids: Tensor, times: Tensor, steps: Tensor) -> CharacterState:
        """Return the states of motions (n,), `steps` (s,) control steps before times (n,) s.

        The result has root states (s * n, 13), DOF positions and velocities (s * n, D), and key
        bodies (s * n, K, 3). In each tensor, all motions at the first step come first, then all
        motions at the second step.
        """
        ids = motion_ids.repeat(len(steps))
        at_s = (times - self._dt_s * steps.unsqueeze(1)).flatten()
        state = self.lib.get_motion_state(ids, at_s)
        root_pos, root_rot, dof_pos, root_vel, root_ang_vel, dof_vel, key_pos = state
        root_states = torch.cat((root_pos, root_rot, root_vel, root_ang_vel), dim=-1)
        return root_states, dof_pos, dof_vel, key_pos

    def windows(self, motion_ids: Tensor, times: Tensor) -> Tensor:
        """Return the AMP observations (n, F) of motions (n,) that end at times (n,) s."""
        parts = []
        for ids, at_s in zip(
            motion_ids.split(_WINDOWS_AT_A_TIME), times.split(_WINDOWS_AT_A_TIME), strict=True
        ):
            features = self._features(self.states(ids, at_s, self._steps))
            parts.append(features.view(len(self._steps), len(ids), -1).transpose(0, 1).flatten(1))
        return torch.cat(parts)

    def draw_windows(self, n: int) -> tuple[Tensor, Tensor]:
        """Draw motions (n,) and end times (n,) s of windows that lie inside the motions."""
        motion_ids = self.lib.sample_motions(n)
        times = self.lib.sample_time(motion_ids, truncate_time=self._history_s) + self._history_s
        if self._motion_share > 0.0:
            is_by_motion = torch.rand(n, device=times.device) < self._motion_share
            by_motion = self.lib.sample_moving_time(motion_ids).clamp(min=self._history_s)
            times = torch.where(is_by_motion, by_motion, times)
        return motion_ids, times

    def draw_pairs(self, n: int, apart_s: float) -> Tensor:
        """Draw pairs (n, 2, F) of AMP observations at most `apart_s` apart in one motion."""
        motion_ids, times = self.draw_windows(n)
        shift_s = apart_s * (2.0 * torch.rand(n, device=times.device) - 1.0)
        last_s = self.lib.get_motion_length(motion_ids).to(times)
        # A clip that is shorter than a window has only one window.
        earliest_s = torch.full_like(times, self._history_s)
        others = torch.maximum(torch.minimum(times + shift_s, last_s), earliest_s)
        return torch.stack([self.windows(motion_ids, at) for at in (times, others)], dim=1)

    def windows_of_clips(self) -> list[Tensor]:
        """Return the AMP observations (W, F) of all control steps of each clip, at least one."""
        windows = []
        for motion_id in range(self.lib.num_motions()):
            left_s = float(self.lib.get_motion_length([motion_id])) - self._history_s
            count = 1 + max(0, int(left_s / self._dt_s))
            device = self._steps.device
            times = self._history_s + self._dt_s * torch.arange(count, device=device)
            windows.append(self.windows(torch.full((count,), motion_id, device=device), times))
        return windows

    def histories(self, states: CharacterState, n: int) -> Tensor:
        """Return the AMP features (n, num_steps - 1, ...) of the older steps of n windows."""
        root, dof_pos, dof_vel, key_pos = states
        before = self._features((root[n:], dof_pos[n:], dof_vel[n:], key_pos[n:]))
        return before.view(len(self._steps) - 1, n, -1).transpose(0, 1)

    def ahead(
        self, motion_ids: Tensor, times: Tensor, ahead_s: Sequence[float]
    ) -> tuple[Tensor, Tensor]:
        """Return root states (n, T, 13) and positions (n, T, K, 3) m of the K key bodies.

        The T moments of motions (n,) are `ahead_s` after times (n,) s.
        """
        if not ahead_s:
            return times.new_zeros(len(times), 0, 13), times.new_zeros(len(times), 0, 0, 3)
        later = -torch.tensor(ahead_s, device=times.device) / self._dt_s
        root, _, _, key_pos = self.states(motion_ids, times, later)
        shape = (len(ahead_s), len(motion_ids))
        root = root.view(*shape, 13).transpose(0, 1)
        return root, key_pos.view(*shape, *key_pos.shape[1:]).transpose(0, 1)


class AdaptiveStarts(Stateful):
    """Draws more start times where recent episodes failed early.

    Episodes that start just before a take-off or a landing often fail early. DeepMimic (Peng et al.
    2018, arXiv 1804.02717) draws start times uniformly. Trackers such as PHC (Luo et al. 2023,
    arXiv 2305.06456) draw clips in proportion to their failures. This class divides clips into bins
    of 0.1 s with equal initial failure rates, and draws bins in proportion to these rates.

    `lengths_s` and `weights` (M,) are the durations and probabilities of M clips. A failure within
    `soon_steps` counts as early.
    """

    stored = ("failure_rate",)

    def __init__(self, lengths_s: Tensor, weights: Tensor, soon_steps: int) -> None:
        counts = (lengths_s / _BIN_S).ceil().long().clamp(min=1)
        self._counts = counts
        self._first = counts.cumsum(0) - counts
        clips = torch.arange(len(counts), device=counts.device)
        self._clip = clips.repeat_interleave(counts)
        self._width_s = (lengths_s / counts)[self._clip]
        place = torch.arange(len(self._clip), device=counts.device) - self._first[self._clip]
        self._start_s = place * self._width_s
        self._share = weights.to(self._width_s)[self._clip] / counts[self._clip]
        self._soon_steps = soon_steps
        self.failure_rate = torch.full_like(self._start_s, 0.5)
        """(B,) shares of early failures among recent episodes that started in the bins."""

    def draw(self, n: int) -> tuple[Tensor, Tensor]:
        """Draw clips (n,) and times (n,) s."""
        weights = self._share * self.failure_rate
        if not bool(weights.sum() > 0):
            weights = self._share
        bins = torch.multinomial(weights, n, replacement=True)
        within = torch.rand(n, device=bins.device)
        return self._clip[bins], self._start_s[bins] + within * self._width_s[bins]

    def bins_of(self, clips: Tensor, times_s: Tensor) -> Tensor:
        """Return the bins (n,) of clip times (n,)."""
        place = (times_s / self._width_s[self._first[clips]]).long()
        return self._first[clips] + torch.minimum(place, self._counts[clips] - 1)

    def count(self, bins: Tensor, steps: Tensor, failed: Tensor) -> None:
        """Update the failure rates by the start bins, control steps and failures of ended episodes.

        Short episodes that did not fail are ignored, because they might have failed soon.
        """
        failed_soon = failed & (steps <= self._soon_steps)
        is_known = failed_soon | (steps > self._soon_steps)
        bins, failed_soon = bins[is_known], failed_soon[is_known]
        episodes = torch.bincount(bins, minlength=len(self._clip))
        failures = torch.bincount(bins[failed_soon], minlength=len(self._clip))
        kept = (1.0 - _UPDATE) ** episodes
        mean = failures / episodes.clamp(min=1)
        self.failure_rate = kept * self.failure_rate + (1.0 - kept) * mean


class ClipStarts(Stateful):
    """Draws the clips and times at which episodes start.

    Starts are drawn in blocks, because one draw of 1000 starts takes as long as ten draws of 50.

    Args:
        motions: the clips.
        config: the settings `state_init` and `adaptive_starts`.
        num_envs: N.
        control_dt_s: duration of a control step.
        soon_limit: episode length in control steps. Only failures in its first half count as early.
        ahead_s: the goal needs the root states at these times (s) after a start.
        ends_with_clip: whether episodes end with their clip.
    """

    stored = ("clips", "times_s", "_rows", "_left", "adaptive")

    def __init__(
        self,
        motions: ReferenceMotions,
        config: HumanoidAMPConfig,
        num_envs: int,
        control_dt_s: float,
        soon_limit: int,
        ahead_s: Sequence[float],
        ends_with_clip: bool,
    ) -> None:
        lib, device = motions.lib, motions.lib.device
        self._motions = motions
        self._steps = torch.arange(config.num_amp_obs_steps, device=device)
        self._starts_at_zero = config.state_init == "Start"
        self._ahead_s = tuple(ahead_s)
        self._least_left_s = _LEAST_LEFT_S if ends_with_clip else None
        self._adaptive_share = config.adaptive_starts
        self.adaptive: AdaptiveStarts | None = None
        if config.adaptive_starts > 0.0:
            self.adaptive = AdaptiveStarts(
                lib.get_motion_length(range(lib.num_motions())),
                lib.motion_weights(),
                min(round(_FAILS_SOON_S / control_dt_s), soon_limit // 2),
            )
        self._block = min(num_envs, _STARTS_AT_A_TIME)
        # Clips and times at which the running episodes started. Clip -1 is the default pose.
        self.clips = torch.full((num_envs,), -1, dtype=torch.int64, device=device)
        self.times_s = torch.zeros(num_envs, device=device)
        self.clear()

    def clear(self) -> None:
        """Discard drawn starts, so that the random generator's state determines the next ones."""
        self._rows: tuple[Tensor, ...] = ()
        self._left = 0

    def next(self, env_ids: Tensor) -> tuple[Tensor, ...]:
        """Return unused starts for environments (n,).

        Returns:
            Root states (n, 13), DOF positions and velocities (n, D), AMP features of the previous
            steps (n, steps - 1, ...), and the root states (n, T, 13) and key body positions
            (n, T, K, 3) m that the goal needs.
        """
        n = len(env_ids)
        if n > self._block:
            rows = self._draw(n)
        else:
            if n > self._left:  # discard the rest of the previous block
                self._rows, self._left = self._draw(self._block), self._block
            first = self._block - self._left
            self._left -= n
            rows = tuple(part[first : first + n] for part in self._rows)
        *states, clips, times_s = rows
        self.clips[env_ids] = clips
        self.times_s[env_ids] = times_s
        return tuple(states)

    @torch.inference_mode()
    def _draw(self, n: int) -> tuple[Tensor, ...]:
        """Draw starts, and return the tensors of `next`, the clips (n,) and the times (n,) s."""
        motions = self._motions
        motion_ids, times = self._draw_moments(n)
        states = motions.states(motion_ids, times, self._steps)
        history = motions.histories(states, n)
        ahead = motions.ahead(motion_ids, times, self._ahead_s)
        root, dof_pos, dof_vel, _ = states
        return root[:n], dof_pos[:n], dof_vel[:n], history, *ahead, motion_ids, times

    def _draw_moments(self, n: int) -> tuple[Tensor, Tensor]:
        lib = self._motions.lib
        motion_ids = lib.sample_motions(n)
        if self._starts_at_zero:
            return motion_ids, torch.zeros(n, device=motion_ids.device)
        times = lib.sample_time(motion_ids, truncate_time=self._least_left_s)
        if self.adaptive is not None:
            is_adaptive = torch.rand(n, device=times.device) < self._adaptive_share
            hard_ids, hard_times = self.adaptive.draw(n)
            motion_ids = torch.where(is_adaptive, hard_ids, motion_ids)
            times = torch.where(is_adaptive, hard_times, times)
        return motion_ids, times
