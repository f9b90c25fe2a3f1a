"""Measures how much of its clips' motion a character shows: nearly nothing if it stands still.

A **moment** is where the bodies are at a time and a little later, seen from the root at the first
time: from its place on the ground and its heading. So poses count, speeds, turns, and the height of
the root. How much later depends on the clip: the bodies must have moved so far that a frozen pose
is another moment. A moment of a clip is shown if the character has one near it. Moments count by
how far the bodies move in them: rest counts little. `docs/imitation_metric.md` explains the
numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from isaacgymenvs_lite.evaluation.body_tracks import Track
from isaacgymenvs_lite.utils.rotations import calc_heading, rotate_about_z

# From the first time of a moment to the second; at most this share of the clip.
_SHORTEST_S, _LONGEST_S, _LONGEST_SHARE = 0.1, 1.0, 0.25
# Beyond this distance a moment is not shown, as a share of the mean distance of the bodies from
# the root: 0.2 m of a human, and 0.08 m where bodies hardly move.
_FAR, _FAR_LEAST = 0.5, 0.2
# As a share of the distance between the moments of the clip and frozen poses.
_FAR_OF_FROZEN = 0.7
# Up to this share of that distance a moment is shown in full, then in part.
_NEAR = 0.5
# A moment must be shown once in the time of so many repetitions of the clips.
_REPETITIONS = 2
# How many falls must begin how near each other.
_LEAST_FALLS, _FALLS_WITHIN_S, _FALLS_SHARE = 4, 0.25, 0.5
_LEAST_SIZE_M = 0.01
# Of a clip that does not move at all every moment counts the same.
_LEAST_WEIGHT_M = 1e-6


@dataclass(frozen=True, eq=False)
class _Moments:
    """The S moments of one clip."""

    apart: int  # control steps from their first time to the second
    rows: Tensor  # (S, 6 J) m
    weights: Tensor  # (S,) m, how far the bodies move, mean
    far_m: float  # beyond this distance (root mean square over bodies and times) none is shown
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
            # A frozen pose is right at the first time, and wrong by the movement at the second.
            frozen_m = moved_m.square().mean(dim=-1).div(2.0).sqrt()
            typical_m = (frozen_m @ weights / weights.sum()).item()
            if _FAR_OF_FROZEN * typical_m >= far_m:
                break
        far_m = max(min(far_m, _FAR_OF_FROZEN * typical_m), far_m * _FAR_LEAST / _FAR)
        return cls(apart, moments.flatten(1), weights, far_m, _height_m(clip))

    def shown(self, track: Track, height_m: float | None = None) -> Tensor:
        """Return how well each moment of an episode shows each of these, (T', S), 0 to 1."""
        if len(track) <= self.apart:
            return torch.zeros(1, len(self.rows))
        moments = _moments(track, self.apart, height_m).flatten(1)
        # Of 3 numbers for each body and time.
        distances_m = torch.cdist(moments, self.rows) / math.sqrt(moments.shape[1] / 3)
        near_m = _NEAR * self.far_m
        return ((self.far_m - distances_m) / (self.far_m - near_m)).clamp(0.0, 1.0)


@dataclass(frozen=True)
class FallMoment:
    """The time of a clip at which many falls begin, and their share.

    They begin within a quarter of a second of it.
    """

    clip: int
    time_s: float
    share: float


class MotionCoverage:
    """Measures which share of the clips' motion episodes show; a row of a track for each `dt_s`."""

    def __init__(self, clips: Sequence[Track], dt_s: float) -> None:
        self._dt_s = dt_s
        self._clips = [_Moments.of(clip, dt_s) for clip in clips]
        self._num_moments = sum(len(clip.rows) for clip in self._clips)

    def share(self, episodes: Sequence[Track], max_steps: int) -> float:
        """Return the mean share, 0 to 1, over stretches of episodes; nan without episodes.

        A stretch takes twice as long as all clips together, or is a whole episode if that is
        shorter (`max_steps` if it does not end early). Of clips longer than a stretch as much is
        expected as fits into it. What an episode does not show because it ended in a fall is
        missing.
        """
        if not episodes:
            return math.nan
        stretch = min(_REPETITIONS * self._num_moments, max_steps)
        whole = torch.stack([clip.weights.sum() for clip in self._clips]).sum()
        expected = whole * min(1.0, stretch / self._num_moments)
        shown = torch.cat([self._shown(track, stretch) for track in episodes])
        return (shown / expected).clamp(max=1.0).mean().item()

    def share_of_rest(self, episodes: Sequence[tuple[Track, float]]) -> float:
        """Return the share, 0 to 1, of what was left of the only clip that episodes show.

        Args:
            episodes: at least one; each with the time (s) of the clip at which it started.
        """
        (clip,) = self._clips
        shown = expected = torch.zeros(())
        for track, start_s in episodes:
            first = min(round(start_s / self._dt_s), len(clip.rows) - 1)
            weights = clip.weights[first:]
            # An episode that gets up sooner or later than the clip has another median height.
            found = clip.shown(track, clip.height_m)[:, first:]
            shown = shown + found.amax(dim=0) @ weights
            expected = expected + weights.sum()
        return (shown / expected).item()

    def fall_moment(self, episodes: Sequence[Track]) -> FallMoment | None:
        """Return the moment at which most of these episodes, which ended in falls, leave the clips.

        None if they leave them here and there, or are fewer than four.
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
        """Return the clip, and the time (s) in it, that an episode showed last."""
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
        # The rest at the end is too short for all of the clips, unless there is nothing else.
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

    Where the moments of a clip are nearly alike, as in a slow crouched walk, each step of the
    episode is near many of them, but counts for one: an episode that starts in the walk and stands
    after half a second has shown half a second of it. The stretch has more `steps` than rows of
    `how_well` (T, S), as its last moment ends with it.
    """
    best, nearest = how_well.max(dim=1)
    most = (best * weights[nearest]).mean() * steps
    return torch.minimum(how_well.amax(dim=0) @ weights, most)


def _height_m(track: Track) -> float:
    return track.body_pos_w[:, 0, 2].median().item()


def _moments(track: Track, apart: int, height_m: float | None = None) -> Tensor:
    """Return the moments (T - apart, 2 J, 3) m of T > 1 steps; of one step that it stays there.

    Heights are measured from `height_m`. None: the median height of the root, as a clip may be
    recorded above or below the ground.
    """
    apart = min(apart, len(track) - 1)
    first = track.body_pos_w[: len(track) - apart]
    origin = first[:, :1].clone()
    origin[..., 2] = _height_m(track) if height_m is None else height_m
    both = torch.cat((first - origin, track.body_pos_w[apart:] - origin), dim=1)
    heading = calc_heading(track.root_rot_w[: len(first)]).unsqueeze(-1)
    return rotate_about_z(heading.cos(), -heading.sin(), both)
