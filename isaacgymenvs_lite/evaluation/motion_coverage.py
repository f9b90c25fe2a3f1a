"""Measures how much of the motion in its clips a character performs.

A **moment** consists of the body positions at two nearby times, relative to the root's ground
position and heading at the first time. A moment therefore describes pose, speed, turning and height
of the root. The time difference depends on the clip: the bodies must move far enough that a frozen
pose is a different moment. A clip's moment counts as shown if the character's motion contains a
similar moment. The weight of a moment is the distance that the bodies move in it, so that a
standing character, which performs only rest, shows little. `docs/imitation_metric.md` explains the
results.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from isaacgymenvs_lite.evaluation.body_tracks import Track
from isaacgymenvs_lite.utils.rotations import calc_heading, rotate_about_z

# Times (s) between the two poses of a moment, and the largest such time as a share of the clip's
# length.
_SHORTEST_S, _LONGEST_S, _LONGEST_SHARE = 0.1, 1.0, 0.25
# A clip's moment is not shown if the distance to the nearest moment of the character exceeds a
# limit. The limit is a share of the bodies' mean distance from the root: 0.2 m for a human, 0.08 m
# if the bodies hardly move.
_FAR, _FAR_LEAST = 0.5, 0.2
# The limit of the distance of moments as a share of the distance between the clip's moments and
# frozen poses.
_FAR_OF_FROZEN = 0.7
# A clip's moment is shown completely if the distance is below this share of the limit, and partly
# if the distance is below the limit.
_NEAR = 0.5
# A character has the time of so many repetitions of the clips to show each moment once.
_REPETITIONS = 2
# Falls have a common time in the clips if there are so many, and this share of them begins within
# this time (s) of it.
_LEAST_FALLS, _FALLS_WITHIN_S, _FALLS_SHARE = 4, 0.25, 0.5
_LEAST_SIZE_M = 0.01
# All moments of a clip without motion have the same weight.
_LEAST_WEIGHT_M = 1e-6


@dataclass(frozen=True, eq=False)
class _Moments:
    """The S moments of one clip."""

    apart: int  # control steps between the two poses of a moment
    rows: Tensor  # (S, 6 J) m
    weights: Tensor  # (S,) m, mean distance that the bodies move in each moment
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
            # A moment of a frozen pose is correct at its first time; its error at the second time
            # is the bodies' movement.
            frozen_m = moved_m.square().mean(dim=-1).div(2.0).sqrt()
            typical_m = (frozen_m @ weights / weights.sum()).item()
            if _FAR_OF_FROZEN * typical_m >= far_m:
                break
        far_m = max(min(far_m, _FAR_OF_FROZEN * typical_m), far_m * _FAR_LEAST / _FAR)
        return cls(apart, moments.flatten(1), weights, far_m, _height_m(clip))

    def shown(self, track: Track, height_m: float | None = None) -> Tensor:
        """Return the similarity (T', S), 0 to 1, of an episode's moments and the clip's moments."""
        if len(track) <= self.apart:
            return torch.zeros(1, len(self.rows))
        moments = _moments(track, self.apart, height_m).flatten(1)
        # A row of a moment has 3 values for each body at each of the two times.
        distances_m = torch.cdist(moments, self.rows) / math.sqrt(moments.shape[1] / 3)
        near_m = _NEAR * self.far_m
        return ((self.far_m - distances_m) / (self.far_m - near_m)).clamp(0.0, 1.0)


@dataclass(frozen=True)
class FallMoment:
    """The time in a clip within 0.25 s of which many falls begin, and the share of these falls."""

    clip: int
    time_s: float
    share: float


class MotionCoverage:
    """Measures the share of the clips' motion that episodes show; tracks have steps of `dt_s`."""

    def __init__(self, clips: Sequence[Track], dt_s: float) -> None:
        self._dt_s = dt_s
        self._clips = [_Moments.of(clip, dt_s) for clip in clips]
        self._num_moments = sum(len(clip.rows) for clip in self._clips)

    def share(self, episodes: Sequence[Track], max_steps: int) -> float:
        """Return the mean share, 0 to 1, over all stretches of episodes, or nan without episodes.

        A stretch is a part of an episode that is twice as long as all clips together, or the whole
        episode (`max_steps` steps without an early end) if the episode is shorter. If the clips are
        longer than a stretch, only as much motion as fits into a stretch is expected. Motion that
        is missing because of a fall lowers the share.
        """
        if not episodes:
            return math.nan
        stretch = min(_REPETITIONS * self._num_moments, max_steps)
        whole = torch.stack([clip.weights.sum() for clip in self._clips]).sum()
        expected = whole * min(1.0, stretch / self._num_moments)
        shown = torch.cat([self._shown(track, stretch) for track in episodes])
        return (shown / expected).clamp(max=1.0).mean().item()

    def share_of_rest(self, episodes: Sequence[tuple[Track, float]]) -> float:
        """Return the share, 0 to 1, that episodes show of the clip after their starting times.

        Args:
            episodes: at least one episode with the time (s) of the clip at which it started.
        """
        (clip,) = self._clips
        shown = expected = torch.zeros(())
        for track, start_s in episodes:
            first = min(round(start_s / self._dt_s), len(clip.rows) - 1)
            weights = clip.weights[first:]
            # An episode in which the character gets up earlier or later than in the clip has
            # another median height.
            found = clip.shown(track, clip.height_m)[:, first:]
            shown = shown + found.amax(dim=0) @ weights
            expected = expected + weights.sum()
        return (shown / expected).item()

    def fall_moment(self, episodes: Sequence[Track]) -> FallMoment | None:
        """Return the time in the clips at which most of these episodes began to fall.

        The result is None if the falls have no common time or if there are fewer than four
        episodes.
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
        """Return the index of the clip, and the time (s) in it, that an episode showed last."""
        found: tuple[int, int, float] | None = None
        for i, clip in enumerate(self._clips):
            how_well, moments = clip.shown(track).max(dim=1)
            steps = how_well.nonzero().flatten()
            if len(steps) > 0 and (found is None or int(steps[-1]) > found[0]):
                step = int(steps[-1])
                found = step, i, int(moments[step]) * self._dt_s
        return None if found is None else found[1:]

    def _shown(self, track: Track, stretch: int) -> Tensor:
        """Return for each stretch of an episode the weight of the moments that it shows."""
        # An incomplete stretch at the end counts only if the episode is shorter than a stretch.
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
    walks for half a second and then stands has shown half a second of the clip. The number of
    `steps` in a stretch exceeds the number of rows of `how_well` (T, S), because the last moment of
    a stretch ends with it.
    """
    best, nearest = how_well.max(dim=1)
    most = (best * weights[nearest]).mean() * steps
    return torch.minimum(how_well.amax(dim=0) @ weights, most)


def _height_m(track: Track) -> float:
    return track.body_pos_w[:, 0, 2].median().item()


def _moments(track: Track, apart: int, height_m: float | None = None) -> Tensor:
    """Return the moments (T - apart, 2 J, 3) m of T steps; a track of a single step is repeated.

    Heights are relative to `height_m`. The default of `height_m` is the median height of the root,
    because a clip may have been recorded above or below the ground.
    """
    apart = min(apart, len(track) - 1)
    first = track.body_pos_w[: len(track) - apart]
    origin = first[:, :1].clone()
    origin[..., 2] = _height_m(track) if height_m is None else height_m
    both = torch.cat((first - origin, track.body_pos_w[apart:] - origin), dim=1)
    heading = calc_heading(track.root_rot_w[: len(first)]).unsqueeze(-1)
    return rotate_about_z(heading.cos(), -heading.sin(), both)
