"""What a task takes from its clips: demonstrations for a discriminator, and starts of episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import CharacterState
from isaacgymenvs_lite.tasks.amp.humanoid_amp_config import HumanoidAMPConfig
from isaacgymenvs_lite.utils.state import Stateful

_BIN_S = 0.1
# Weight of an episode in the failure rate of its bin.
_UPDATE = 0.02
# Windows of clips computed at a time: many more leave the CPU's cache and take twice as long.
_WINDOWS_AT_A_TIME = 256
_STARTS_AT_A_TIME = 1024
# A failure in this time is one of the start: about as long as a leap with its landing.
_FAILS_SOON_S = 1.5
# An episode that ends with its clip lasts at least so long.
_LEAST_LEFT_S = 0.5


class ReferenceMotions:
    """States and AMP observations of a task's clips, at any time and drawn at random.

    An AMP observation is a window of `num_steps` control steps, the newest first, flattened to F
    numbers. Clips are drawn by their weights. All tensors are on the library's device.

    Args:
        lib: the clips.
        features: from states of characters to one step of an AMP observation.
        num_steps: control steps in an AMP observation.
        control_dt_s: control step.
        motion_share: share of the windows that are drawn in proportion to the motion in the clip at
            each time, not evenly.
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
        """Return states of motions (n,) at times (n,) s, `steps` (s,) control steps earlier.

        Root states (s * n, 13), DOF positions and velocities (s * n, D), key bodies (s * n, K, 3):
        all motions at the first step, then all of them at the second one.
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
        """Draw motions (n,), and the last instants (n,) s of windows that lie inside them."""
        motion_ids = self.lib.sample_motions(n)
        times = self.lib.sample_time(motion_ids, truncate_time=self._history_s) + self._history_s
        if self._motion_share > 0.0:
            is_by_motion = torch.rand(n, device=times.device) < self._motion_share
            by_motion = self.lib.sample_moving_time(motion_ids).clamp(min=self._history_s)
            times = torch.where(is_by_motion, by_motion, times)
        return motion_ids, times

    def draw_pairs(self, n: int, apart_s: float) -> Tensor:
        """Draw pairs (n, 2, F) of AMP observations of one motion, at most `apart_s` apart.

        The clip's start and end limit the distance further.
        """
        motion_ids, times = self.draw_windows(n)
        shift_s = apart_s * (2.0 * torch.rand(n, device=times.device) - 1.0)
        last_s = self.lib.get_motion_length(motion_ids).to(times)
        # Of a clip shorter than the history the window is always the same.
        earliest_s = torch.full_like(times, self._history_s)
        others = torch.maximum(torch.minimum(times + shift_s, last_s), earliest_s)
        return torch.stack([self.windows(motion_ids, at) for at in (times, others)], dim=1)

    def windows_of_clips(self) -> list[Tensor]:
        """Return the AMP observations (W, F) of each clip, one for each control step.

        A clip shorter than the history gives one.
        """
        windows = []
        for motion_id in range(self.lib.num_motions()):
            left_s = float(self.lib.get_motion_length([motion_id])) - self._history_s
            count = 1 + max(0, int(left_s / self._dt_s))
            device = self._steps.device
            times = self._history_s + self._dt_s * torch.arange(count, device=device)
            windows.append(self.windows(torch.full((count,), motion_id, device=device), times))
        return windows

    def histories(self, states: CharacterState, n: int) -> Tensor:
        """Return the AMP features (n, num_steps - 1, ...) of all but the newest step of `states`.

        Args:
            states: of n motions, at all steps of an AMP observation.
            n: number of motions.
        """
        root, dof_pos, dof_vel, key_pos = states
        before = self._features((root[n:], dof_pos[n:], dof_vel[n:], key_pos[n:]))
        return before.view(len(self._steps) - 1, n, -1).transpose(0, 1)

    def roots_ahead(self, motion_ids: Tensor, times: Tensor, ahead_s: Sequence[float]) -> Tensor:
        """Return the root states (n, T, 13) of motions (n,), `ahead_s` (T) s after times (n,) s."""
        if not ahead_s:
            return torch.zeros(len(motion_ids), 0, 13, device=times.device)
        later = -torch.tensor(ahead_s, device=times.device) / self._dt_s
        roots = self.states(motion_ids, times, later)[0]
        return roots.view(len(ahead_s), len(motion_ids), 13).transpose(0, 1)


class AdaptiveStarts(Stateful):
    """Draws moments of clips by how often episodes that start there fail soon.

    Episodes that start just before a take-off or a landing end soon, and teach what the others need
    later. Peng et al. 2018, "DeepMimic" (arXiv 1804.02717), start anywhere in a clip; trackers draw
    clips by their failures (Luo et al. 2023, "PHC", arXiv 2305.06456).

    Clips are cut into bins of a tenth of a second. At first all moments are equal.

    Args:
        lengths_s: (M,) of the clips.
        weights: (M,) how often each clip is drawn, sum 1.
        soon_steps: control steps; a failure in them is one of the start.
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
        """(B,) of the episodes that started in each bin, the newest count most."""

    def draw(self, n: int) -> tuple[Tensor, Tensor]:
        """Return clips (n,) and times (n,) s."""
        weights = self._share * self.failure_rate
        if not bool(weights.sum() > 0):
            weights = self._share
        bins = torch.multinomial(weights, n, replacement=True)
        within = torch.rand(n, device=bins.device)
        return self._clip[bins], self._start_s[bins] + within * self._width_s[bins]

    def bins_of(self, motion_ids: Tensor, times_s: Tensor) -> Tensor:
        """Return the bins (n,) of moments (n,)."""
        place = (times_s / self._width_s[self._first[motion_ids]]).long()
        return self._first[motion_ids] + torch.minimum(place, self._counts[motion_ids] - 1)

    def count(self, bins: Tensor, steps: Tensor, failed: Tensor) -> None:
        """Take in episodes that ended; those that were cut off early do not count.

        Args:
            bins: (n,) where they started.
            steps: (n,) control steps that they lasted.
            failed: (n,) bool.
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
    """Draws moments of clips in which episodes start.

    Starts are drawn in blocks: for the few environments that a step resets the call itself is the
    cost, and a thousand starts take as long as fifty, ten times.

    Args:
        motions: the clips.
        config: of the task: `state_init`, `adaptive_starts`.
        num_envs: N.
        soon_limit: control steps; a failure within half of them counts for the start at most.
        ahead_s: how far ahead, in s, the goal looks from a start.
        ends_with_clip: whether episodes end with their clip.

    Attributes:
        clips: (N,) in which the episodes started, -1: in the default pose.
        times_s: (N,) s, when in them.
        adaptive: where episodes fail; None without `adaptive_starts`.
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
        self.clips = torch.full((num_envs,), -1, dtype=torch.int64, device=device)
        self.times_s = torch.zeros(num_envs, device=device)
        self.clear()

    def clear(self) -> None:
        """Drop the starts that were drawn; the next ones depend on the generator's state."""
        self._rows: tuple[Tensor, ...] = ()
        self._left = 0

    def next(self, env_ids: Tensor) -> tuple[Tensor, ...]:
        """Return starts of environments (n,), which no episode has had before.

        Returns:
            Root states (n, 13), DOF positions and velocities (n, D), the AMP features of the steps
            before (n, steps - 1, ...), and the root states that the goal looks ahead (n, T, 13).
        """
        n = len(env_ids)
        if n > self._block:
            rows = self._draw(n)
        else:
            if n > self._left:  # what is left of a block that is too small is dropped
                self._rows, self._left = self._draw(self._block), self._block
            first = self._block - self._left
            self._left -= n
            rows = tuple(part[first : first + n] for part in self._rows)
        *states, clips, times_s = rows
        self.clips[env_ids] = clips
        self.times_s[env_ids] = times_s
        return tuple(states)

    def count_ended(self, env_ids: Tensor, steps: Tensor, failed: Tensor) -> None:
        """Learn where episodes fail: those of environments (n,) that ended after `steps` (n,).

        Args:
            env_ids: (n,).
            steps: (n,) control steps.
            failed: (n,) bool.
        """
        if self.adaptive is not None and len(env_ids) > 0:
            bins = self.adaptive.bins_of(self.clips[env_ids], self.times_s[env_ids])
            self.adaptive.count(bins, steps, failed)

    @torch.inference_mode()
    def _draw(self, n: int) -> tuple[Tensor, ...]:
        """Return what `next` returns, and the clips (n,) and times (n,) s of the starts."""
        motions = self._motions
        motion_ids, times = self._draw_moments(n)
        states = motions.states(motion_ids, times, self._steps)
        history = motions.histories(states, n)
        ahead = motions.roots_ahead(motion_ids, times, self._ahead_s)
        root, dof_pos, dof_vel, _ = states
        return root[:n], dof_pos[:n], dof_vel[:n], history, ahead, motion_ids, times

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
