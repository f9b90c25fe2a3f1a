"""Measures how much of its clips' motion a character shows; a standing character shows little.

A **moment** consists of the body positions at a time and a little later, relative to the root's
ground position and heading at the first time. It therefore describes pose, speed, turning and
height of the root. The time difference depends on the clip: the bodies must move far enough that a
frozen pose is a different moment. A moment of a clip counts as shown if the character's motion
contains a similar moment. Its weight is the distance that the bodies move in it, so that rest has
little weight.
`docs/imitation_metric.md` explains the results.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from isaacgymenvs_lite.evaluation.body_tracks import Track
from isaacgymenvs_lite.utils.rotations import calc_heading, rotate_about_z

# Time from the first to the second pose of a moment, and its largest share of the clip.
_SHORTEST_S, _LONGEST_S, _LONGEST_SHARE = 0.1, 1.0, 0.25
# A moment at a larger distance is not shown. The distance is a share of the bodies' mean distance
# from the root: 0.2 m for a human, 0.08 m if the bodies hardly move.
_FAR, _FAR_LEAST = 0.5, 0.2
# The same limit as a share of the distance between the clip's moments and frozen poses.
_FAR_OF_FROZEN = 0.7
# A moment is shown completely up to this share of the limit, and partly up to the limit.
_NEAR = 0.5
# A moment must be shown once within the time of this many repetitions of the clips.
_REPETITIONS = 2
# Smallest number of falls, and the largest time between them.
_LEAST_FALLS, _FALLS_WITHIN_S, _FALLS_SHARE = 4, 0.25, 0.5
_LEAST_SIZE_M = 0.01
# All moments of a clip without motion have the same weight.
_LEAST_WEIGHT_M = 1e-6


@dataclass(frozen=True, eq=False)
class _Moments:
    """The S moments of one clip."""

    apart: int  # control steps between the two poses of a moment
    rows: Tensor  # (S, 6 J) m
    weights: Tensor  # (S,) m, mean distance that the bodies move
    far_m: float  # largest distance (root mean square over bodies and times) of a shown moment
    height_m: float  # median height of the root

    @classmethod
    def of(cls, clip: Track, dt_s: float) -> _Moments:
        most = min(_LONGEST_S / dt_s, _LONGEST_SHARE * len(clip))
        first, last = (max(1, round(steps)) for steps in (_SHORTEST_S / dt_s, most))
        size_m = (clip.body_pos_w[:, 1:] - clip.body_pos_w[:, :1]).norm(dim=-1).mean().item()
        far_m = _FAR * max(size_m, _LEAST_SIZE_M)
        for apart in range(min(first, last), last + 1):
            moments = _moments(clip, apart)
            start, later = moments.chunk(2, dim=1)
            moved_m = (later - start).norm(dim=-1)
            weights = moved_m.mean(dim=-1) + _LEAST_WEIGHT_M
            # A frozen pose is correct at the first time and wrong by the movement at the second.
            frozen_m = moved_m.square().mean(dim=-1).div(2.0).sqrt()
            typical_m = (frozen_m @ weights / weights.sum()).item()
            if _FAR_OF_FROZEN * typical_m >= far_m:
                break
        far_m = max(min(far_m, _FAR_OF_FROZEN * typical_m), far_m * _FAR_LEAST / _FAR)
        return cls(apart, moments.flatten(1), weights, far_m, _height_m(clip))

    def shown(self, track: Track, height_m: float | None = None) -> Tensor:
        """Return how well each moment of an episode shows each clip moment, (T', S), 0 to 1."""
        if len(track) <= self.apart:
            return torch.zeros(1, len(self.rows))
        moments = _moments(track, self.apart, height_m).flatten(1)
        # A row has 3 values for each body and time.
        distances_m = torch.cdist(moments, self.rows) / math.sqrt(moments.shape[1] / 3)
        near_m = _NEAR * self.far_m
        return ((self.far_m - distances_m) / (self.far_m - near_m)).clamp(0.0, 1.0)


@dataclass(frozen=True)
class FallMoment:
    """The time of a clip at which many falls begin (within 0.25 s), and their share."""

    clip: int
    time_s: float
    share: float


class MotionCoverage:
    """Measures the share of the clips' motion that episodes show; tracks have a row per `dt_s`."""

    def __init__(self, clips: Sequence[Track], dt_s: float) -> None:
        self._dt_s = dt_s
        self._clips = [_Moments.of(clip, dt_s) for clip in clips]
        self._num_moments = sum(len(clip.rows) for clip in self._clips)

    def share(self, episodes: Sequence[Track], max_steps: int) -> float:
        """Return the mean share, 0 to 1, over stretches of episodes; nan without episodes.

        A stretch is twice as long as all clips together, or a whole episode if that is shorter
        (`max_steps` steps without an early end). If the clips are longer than a stretch, only the
        part that fits into the stretch is expected. Motion that is missing because of a fall lowers
        the share.
        """
        if not episodes:
            return math.nan
        stretch = min(_REPETITIONS * self._num_moments, max_steps)
        whole = torch.stack([clip.weights.sum() for clip in self._clips]).sum()
        expected = whole * min(1.0, stretch / self._num_moments)
        shown = torch.cat([self._shown(track, stretch) for track in episodes])
        return (shown / expected).clamp(max=1.0).mean().item()

    def share_of_rest(self, episodes: Sequence[tuple[Track, float]]) -> float:
        """Return the share, 0 to 1, of the rest of the only clip that episodes show.

        Args:
            episodes: at least one episode with the time (s) of the clip at which it started.
        """
        (clip,) = self._clips
        shown = expected = torch.zeros(())
        for track, start_s in episodes:
            first = min(round(start_s / self._dt_s), len(clip.rows) - 1)
            weights = clip.weights[first:]
            # The median height differs if an episode gets up earlier or later than the clip.
            found = clip.shown(track, clip.height_m)[:, first:]
            shown = shown + found.amax(dim=0) @ weights
            expected = expected + weights.sum()
        return (shown / expected).item()

    def fall_moment(self, episodes: Sequence[Track]) -> FallMoment | None:
        """Return the moment of the clips at which most of these falling episodes began to fall.

        The result is None if there is no common moment or if there are fewer than four episodes.
        """
        last = [found for track in episodes if (found := self._last_shown(track)) is not None]
        if len(last) < _LEAST_FALLS:
            return None
        times_s = torch.tensor([time_s for _, time_s in last])
        clips = torch.tensor([clip for clip, _ in last])
        near = (times_s[:, None] - times_s).abs() <= _FALLS_WITHIN_S
        near &= clips[:, None] == clips
        most = int(near.sum(dim=1).argmax())
        share = near[most].float().mean().item()
        if share < _FALLS_SHARE:
            return None
        return FallMoment(last[most][0], times_s[near[most]].median().item(), share)

    def _last_shown(self, track: Track) -> tuple[int, float] | None:
        """Return the clip and the time in it (s) that an episode showed last."""
        found: tuple[int, int, float] | None = None
        for i, clip in enumerate(self._clips):
            how_well, moments = clip.shown(track).max(dim=1)
            steps = how_well.nonzero().flatten()
            if len(steps) > 0 and (found is None or int(steps[-1]) > found[0]):
                step = int(steps[-1])
                found = step, i, int(moments[step]) * self._dt_s
        return None if found is None else found[1:]

    def _shown(self, track: Track, stretch: int) -> Tensor:
        """Return the sum of the weights that each stretch of an episode shows."""
        # The rest at the end counts only if the episode is shorter than a stretch.
        num_stretches = max(1, len(track) // stretch)
        sums = torch.zeros(num_stretches)
        for clip in self._clips:
            parts = clip.shown(track).split(stretch)[:num_stretches]
            for i, part in enumerate(parts):
                steps = min(stretch, len(track) - i * stretch)
                sums[i] += _weight_shown(part, clip.weights, steps)
        return sums


def _weight_shown(how_well: Tensor, weights: Tensor, steps: int) -> Tensor:
    """Return the weight () of the moments that a stretch of an episode shows.

    The moments of a clip may be nearly alike, for example in a slow crouched walk, so that each
    step of an episode is near many moments. A step counts for only one moment: an episode that
    walks for half a second and then stands has shown half a second of the clip. A stretch has more
    `steps` than rows of `how_well` (T, S), because its last moment ends with the stretch.
    """
    best, nearest = how_well.max(dim=1)
    most = (best * weights[nearest]).mean() * steps
    return torch.minimum(how_well.amax(dim=0) @ weights, most)


def _height_m(track: Track) -> float:
    return track.body_pos_w[:, 0, 2].median().item()


def _moments(track: Track, apart: int, height_m: float | None = None) -> Tensor:
    """Return the moments (T - apart, 2 J, 3) m of T steps; a single step is repeated.

    Heights are relative to `height_m`. Its default is the median height of the root, because a clip
    may have been recorded above or below the ground.
    """
    apart = min(apart, len(track) - 1)
    first = track.body_pos_w[: len(track) - apart]
    origin = first[:, :1].clone()
    origin[..., 2] = _height_m(track) if height_m is None else height_m
    both = torch.cat((first - origin, track.body_pos_w[apart:] - origin), dim=1)
    heading = calc_heading(track.root_rot_w[: len(first)]).unsqueeze(-1)
    return rotate_about_z(heading.cos(), -heading.sin(), both)
