"""The motion library provides batches of reference states from clips at any time.

Sampling follows the motion libraries of AMP and ASE. Quaternions are xyzw.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.interpolation import FRAMES, Moments, MotionState
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.plausibility import (
    bodies_on_ground,
    put_on_ground,
    warn_of_implausible,
)
from isaacgymenvs_lite.motion.skeleton import Skeleton, skeleton_for_num_dofs

__all__ = ["MotionLib", "MotionState"]

_log = logging.getLogger(__name__)

# Factor of times, so that a frame's time, rounded down to float32, selects this frame.
_TIME_ROUNDING = 1.0 + 1e-7

# The amount of motion in a bin is the mean distance that the bodies cover in `_MOTION_S`.
_MOTION_S, _MOTION_BIN_S = 0.1, 1.0 / 30.0
_LEAST_MOTION_M = 1e-6

_Ids = Tensor | npt.NDArray[np.integer] | Sequence[int]
_Times = Tensor | npt.NDArray[np.floating] | Sequence[float]


class MotionLib:
    """Clips of a humanoid or robot, sampled in proportion to weights and evaluated at any time.

    Args:
        motion_file: a clip or a data set (see `loader.load_clips`).
        num_dofs: degrees of freedom, which select a shipped humanoid.
        key_body_ids: K body ids whose positions `get_motion_state` returns.
        device: device of the tensors.
        repair_repeated_frames: whether copies are dropped from clips that store every pose twice.
        skeleton: the skeleton of a robot that is not a shipped humanoid.
        interpolation: `published` or `spline` (see the module `interpolation`). Tasks use `spline`.
        ground: whether the lowest points of each clip are put on the ground.

    Attributes:
        skeleton: the skeleton of the clips.
        implausible: maps names of clips to descriptions of implausible motion.

    Raises:
        MotionFileError: a clip cannot be used.
        ConfigError: the skeleton, a key body or the interpolation does not exist.
    """

    def __init__(
        self,
        motion_file: str | Path,
        num_dofs: int,
        key_body_ids: _Ids,
        device: str | torch.device,
        repair_repeated_frames: bool = False,
        skeleton: Skeleton | None = None,
        interpolation: str = "published",
        ground: bool = False,
    ) -> None:
        if interpolation not in FRAMES:
            raise ConfigError(unknown("interpolation", interpolation, FRAMES))
        self.skeleton = skeleton or skeleton_for_num_dofs(num_dofs)
        if self.skeleton.num_dofs != num_dofs:
            raise ConfigError(
                f"num_dofs is {num_dofs}, but the skeleton has {self.skeleton.num_dofs}"
            )
        self.device = torch.device(device)
        key_ids = [int(body) for body in key_body_ids]
        for body in key_ids:
            if not 0 <= body < self.skeleton.num_bodies:
                raise ConfigError(
                    f"key body {body} does not exist, expected ids from 0 to "
                    f"{self.skeleton.num_bodies - 1}"
                )
        clips_and_weights = load_clips(motion_file, self.skeleton)
        self._clips = [
            _without_copies(clip, repair_repeated_frames) for clip, _ in clips_and_weights
        ]
        if ground:
            self._clips = [put_on_ground(clip, self.skeleton) for clip in self._clips]
        self.implausible = warn_of_implausible(self._clips, self.skeleton)
        cumulative = np.cumsum([weight for _, weight in clips_and_weights], dtype=np.float64)
        self._cumulative_weights = torch.from_numpy(cumulative / cumulative[-1]).to(self.device)
        num_frames = np.array([clip.num_frames for clip in self._clips])
        first_rows = np.cumsum(num_frames) - num_frames
        lengths_s = [clip.length_s for clip in self._clips]
        frame_times_s = [1.0 / clip.fps for clip in self._clips]
        table = np.stack((first_rows, num_frames - 1, lengths_s, frame_times_s), axis=-1)
        self._motions = torch.from_numpy(table).to(self.device)
        self._lengths_s = self._motions[:, 2].float()
        self._frames = FRAMES[interpolation](self._clips, self.skeleton, key_ids, self.device)

    def num_motions(self) -> int:
        """Return the number of clips."""
        return len(self._clips)

    def get_total_length(self) -> float:
        """Return the duration of all clips together, in s."""
        return sum(clip.length_s for clip in self._clips)

    def fastest_clip_m_s(self) -> float:
        """Return the largest mean horizontal speed of the root in a clip, m/s."""
        velocities = (clip.linear_velocity_w[:, 0, :2] for clip in self._clips)
        return max(float(np.linalg.norm(v, axis=-1).mean()) for v in velocities)

    def bodies_on_ground(self) -> list[str]:
        """Return the names of the bodies that touch the ground in the clips."""
        return bodies_on_ground(self._clips, self.skeleton)

    def get_motion(self, motion_id: int) -> MotionClip:
        """Return a clip; its bodies are in the order of the skeleton."""
        return self._clips[motion_id]

    def motion_weights(self) -> Tensor:
        """Return the sampling probability of each clip (M,)."""
        return torch.diff(self._cumulative_weights, prepend=self._cumulative_weights.new_zeros(1))

    def get_motion_length(self, motion_ids: _Ids) -> Tensor:
        """Return the durations (n,) of clips (n,) in s: (frames - 1) / fps."""
        return self._lengths_s[torch.as_tensor(motion_ids, dtype=torch.long, device=self.device)]

    def sample_motions(self, n: int) -> Tensor:
        """Draw clip ids (n,) from torch's generator, with replacement, in proportion to weights."""
        uniform = torch.rand(n, device=self.device, dtype=torch.float64)
        return torch.searchsorted(self._cumulative_weights, uniform, right=True)

    def sample_time(self, motion_ids: _Ids, truncate_time: float | None = None) -> Tensor:
        """Draw times (n,) s in the clips (n,), but not in their last `truncate_time` s.

        The time is 0 if a clip is shorter than `truncate_time`.
        """
        lengths = self.get_motion_length(motion_ids)
        if truncate_time is not None:
            if truncate_time < 0.0:
                raise ConfigError(f"truncate_time is {truncate_time} s, expected at least 0")
            lengths = (lengths - truncate_time).clamp(min=0.0)
        return torch.rand_like(lengths) * lengths

    def sample_moving_time(self, motion_ids: _Ids) -> Tensor:
        """Draw times (n,) s in the clips (n,) with a density proportional to the motion.

        The motion is the mean distance that the bodies cover in 0.1 s. In a clip without motion,
        the density is uniform.
        """
        ids = torch.as_tensor(motion_ids, dtype=torch.long, device=self.device)
        cumulative, first_bins, widths_s = self._motion_bins
        # The cumulative motion in clip k is scaled so that it rises from k to k + 1.
        wanted = ids + torch.rand(len(ids), device=self.device, dtype=torch.float64)
        bins = torch.searchsorted(cumulative, wanted, right=True) - first_bins[ids]
        within = torch.rand(len(ids), device=self.device)
        times_s = (bins + within) * widths_s[ids]
        return torch.minimum(times_s, self._lengths_s[ids])

    @functools.cached_property
    def _motion_bins(self) -> tuple[Tensor, Tensor, Tensor]:
        """Cumulative motion (B,) of bins; the clips' first bins (M,) and bin widths (M,) s."""
        cumulative, counts, widths_s = [], [], []
        for motion_id, length_s in enumerate(self._lengths_s.tolist()):
            count = max(1, round(length_s / _MOTION_BIN_S))
            width_s = length_s / count
            centres_s = (torch.arange(count, dtype=torch.float64) + 0.5) * width_s
            ids = torch.full((count,), motion_id)
            before, after = (
                self.get_body_pos(ids, (centres_s + shift_s).clamp(0.0, length_s))
                for shift_s in (-0.5 * _MOTION_S, 0.5 * _MOTION_S)
            )
            moved_m = (after - before).norm(dim=-1).mean(dim=-1).double() + _LEAST_MOTION_M
            cumulative.append(motion_id + moved_m.cumsum(0) / moved_m.sum())
            counts.append(count)
            widths_s.append(width_s)
        firsts = torch.tensor([0, *counts[:-1]], device=self.device).cumsum(0)
        return torch.cat(cumulative), firsts, torch.tensor(widths_s, device=self.device)

    def get_motion_state(self, motion_ids: _Ids, motion_times: _Times) -> MotionState:
        """Return the states of clips (n,) at times (n,) in s.

        Before the start of a clip, the state is extrapolated. After the end of a clip, the state
        has the last pose of the clip.
        """
        return self._frames.states(self._moments(motion_ids, motion_times))

    def get_body_pos(self, motion_ids: _Ids, motion_times: _Times) -> Tensor:
        """Return the world positions (n, J, 3) m of all bodies of clips (n,) at times (n,) in s."""
        return self._frames.body_pos(self._moments(motion_ids, motion_times))

    def _moments(self, motion_ids: _Ids, motion_times: _Times) -> Moments:
        """Find the frames before and after times (n,) s of clips (n,)."""
        ids = torch.as_tensor(motion_ids, dtype=torch.long, device=self.device)
        times = torch.as_tensor(motion_times, dtype=torch.float64, device=self.device)
        start, last, length, dt = self._motions.index_select(0, ids).unbind(-1)
        first = torch.floor((times / length).clamp(0.0, 1.0) * last * _TIME_ROUNDING)
        blend = (times - first * dt) / dt
        row = start + first
        next_row = start + torch.minimum(first + 1.0, last)
        return Moments(row.long(), next_row.long(), blend.float(), dt.float())


def _without_copies(clip: MotionClip, repair: bool) -> MotionClip:
    """Drop copies of frames that are stored twice, or only log a warning if `repair` is False."""
    if clip.find_repeated_frames() is None:
        return clip
    if not repair:
        _log.warning(
            "%s: every frame is stored twice (%g Hz data at %g Hz): joint velocities alternate "
            "between 0 and twice the true speed; repair_repeated_frames=True "
            "(task.env.repairRepeatedFrames) drops the copies",
            clip.name,
            clip.fps / 2.0,
            clip.fps,
        )
        return clip
    repaired = clip.drop_repeated_frames()
    _log.info(
        "%s: every frame was stored twice: dropped the copies, %d frames at %g Hz remain",
        clip.name,
        repaired.num_frames,
        repaired.fps,
    )
    return repaired
