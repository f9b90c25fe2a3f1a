"""Measures how closely a character imitates its clips: the pose error in metres of the AMP paper.

The error of a frame is the mean distance between the bodies of the character and of the reference,
relative to the roots and in their heading frames. An episode is aligned with the repeated clip by
subsequence dynamic time warping, because the policy chooses phase and tempo.
`docs/imitation_metric.md` explains the results.

References:
    Peng et al., "AMP: Adversarial Motion Priors for Stylized Physics-Based Character Control",
    2021, https://arxiv.org/abs/2104.02180 (section 8: the pose error).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from isaacgymenvs_lite.evaluation.body_tracks import Track
from isaacgymenvs_lite.evaluation.motion_coverage import FallMoment, MotionCoverage
from isaacgymenvs_lite.utils.rotations import calc_heading, rotate_about_z

# Every cell of a path adds `_CELL` to the imaginary part of the path's cost, and every step in the
# reference adds `_ADVANCE`.
_CELL = 1.0
_ADVANCE = 2.0**-24


@dataclass(frozen=True, eq=False)
class Alignment:
    """The cheapest warping paths of E episodes."""

    # (E,) float64, cost of the path including the cost of its steps, divided by the number of
    # cells.
    mean_cost: npt.NDArray[np.float64]
    # (E,) int, reference frames from the first to the last cell of the path.
    advance: npt.NDArray[np.int64]


def align(
    cost: npt.NDArray[np.floating],
    lengths: npt.NDArray[np.integer],
    num_columns: npt.NDArray[np.integer],
    off_tempo: float = 0.0,
) -> Alignment:
    """Align episodes with a reference by subsequence dynamic time warping.

    A path visits cells (t, s), from any cell of an episode's first row to any cell of its last row,
    by the steps (1, 0), (0, 1) and (1, 1). The cheapest path has the smallest sum of costs. Among
    equally cheap paths the path with the fewest cells is chosen, then the path with the smallest
    advance in the reference. The time is O(E T S); the memory in addition to `cost` is O(E T).

    Args:
        cost: (T, S, E) non-negative cost of frame t of episode e at reference frame s.
        lengths: (E,) lengths of the episodes; later rows are ignored.
        num_columns: (E,) numbers of reference frames; a number above S repeats the reference from
            its start.
        off_tempo: cost of a step (1, 0) or (0, 1), so that the path prefers (1, 1) if all cells
            have a similar cost.
    """
    num_rows, num_frames, num_episodes = cost.shape
    max_columns = int(num_columns.max())

    # The real part is a path's cost; the imaginary part contains the number of its cells and its
    # advance. numpy orders complex numbers by the real part and then by the imaginary part, which
    # is the rule for equally cheap paths. Row 0 is before the episode, and every path begins in row
    # 0 without cost. The cells of an anti-diagonal depend only on the two previous anti-diagonals,
    # so three arrays take turns.
    older, old, new = (np.full((num_rows + 1, num_episodes), np.inf + 0j) for _ in range(3))
    for diagonal in (older, old, new):
        diagonal[0] = 0.0
    best: npt.NDArray[np.complex128] = np.full(num_episodes, np.inf + 0j)
    episodes = np.arange(num_episodes)
    rows = np.arange(num_rows)
    stay = np.full((num_rows, 1), off_tempo)
    stay[0] = 0.0  # a path begins here
    for k in range(num_rows + max_columns - 1):
        first, last = max(0, k - max_columns + 1), min(num_rows, k + 1)
        t = rows[first:last]
        before = np.minimum(old[t + 1] + off_tempo, older[t])  # (t, s - 1) and (t - 1, s - 1)
        before += 1j * _ADVANCE
        np.minimum(before, old[t] + stay[t], out=before)  # (t - 1, s)
        before += cost[t, (k - t) % num_frames]
        before += 1j * _CELL
        new[first + 1 : last + 1] = before

        end_column = k - (lengths - 1)
        ends = episodes[(end_column >= 0) & (end_column < num_columns)]
        best[ends] = np.minimum(best[ends], new[lengths[ends], ends])
        older, old, new = old, new, older

    cells = np.floor(best.imag)
    advance = np.rint((best.imag - cells) / _ADVANCE)
    return Alignment(best.real / cells, advance.astype(np.int64))


# The reference is repeated often enough for a character that moves at this multiple of its tempo.
_MAX_TEMPO = 2
# Cost of a step (1, 0) or (0, 1), as a share of the bodies' mean distance from the root: 7 mm for a
# human. This cost keeps the clip's tempo where poses are nearly alike, as in a turn on the spot, so
# that the nearest frame is not a matter of chance. The measured tempo of a walk at half the tempo
# is still a half.
_OFF_TEMPO = 0.02
# Upper limit of the cost tensors of one chunk of episodes, in bytes.
_CHUNK_BYTES = 200 * 2**20


def root_relative_pose(body_pos_w: Tensor, root_rot_w: Tensor) -> Tensor:
    """Return body positions (..., J, 3) m relative to the root, in its heading frame.

    Args:
        body_pos_w: (..., J, 3) m in the world, z up; body 0 is the root.
        root_rot_w: (..., 4) xyzw rotation of the root.
    """
    heading = calc_heading(root_rot_w).unsqueeze(-1)
    return rotate_about_z(heading.cos(), -heading.sin(), body_pos_w - body_pos_w[..., :1, :])


class ReferencePoses:
    """The poses of the reference clips, one for each control step; a clip repeats for ever.

    Args:
        clips: for each clip its poses (F, J, 3) m, F >= 1, from `root_relative_pose`, one for each
            control step. A cyclic clip must not repeat its first pose at the end.
    """

    def __init__(self, clips: Sequence[Tensor | npt.NDArray[np.floating]]) -> None:
        self.clips = tuple(torch.as_tensor(c, dtype=torch.float32, device="cpu") for c in clips)
        self.num_bodies = self.clips[0].shape[1]

    @classmethod
    def from_tracks(cls, tracks: Sequence[Track]) -> ReferencePoses:
        """Return the poses of clips whose tracks have a row for each control step."""
        return cls([root_relative_pose(t.body_pos_w, t.root_rot_w) for t in tracks])


@dataclass(frozen=True, eq=False)
class Episode:
    """One recorded episode."""

    poses: Tensor  # (T, J, 3) m, float32 on the CPU, `root_relative_pose` of every control step
    fell: bool  # whether the episode ended early by a fall
    # Positions of the bodies, from which the share of the motion is measured, or None.
    track: Track | None = None
    # Time (s) in the only clip at which the episode started, if episodes end with the clip.
    start_s: float | None = None


class EpisodeRecorder:
    """Collects the same number of episodes from each environment.

    Equal numbers avoid a bias, because short episodes end first. Steps of an environment after its
    last episode are not stored.

    Args:
        num_envs: number of environments N.
        num_bodies: number of bodies J.
        max_steps: longest episode in control steps; later steps of an episode are dropped.
        device: device of the arguments of `record`.
        episodes_per_env: number of episodes to store from each environment.
        wait_for_reset: whether to skip the episodes that are running now.
    """

    def __init__(
        self,
        num_envs: int,
        num_bodies: int,
        max_steps: int,
        device: str | torch.device,
        episodes_per_env: int = 1,
        wait_for_reset: bool = False,
    ) -> None:
        self.episodes: list[Episode] = []
        self._max_steps = max_steps
        # An additional slot receives the dropped steps, so that `record` needs no branch.
        shape = (num_envs, max_steps + 1)
        self._body_pos_w = torch.zeros(*shape, num_bodies, 3, device=device)
        self._root_rot_w = torch.zeros(*shape, 4, device=device)
        self._rows = torch.arange(num_envs, device=device)
        self._slots = torch.full((num_envs,), max_steps if wait_for_reset else 0, device=device)
        self._left = [episodes_per_env] * num_envs
        self._waiting = [wait_for_reset] * num_envs

    @property
    def complete(self) -> bool:
        """Whether all episodes of every environment are stored."""
        return not any(self._left)

    def record(self, body_pos_w: Tensor, root_rot_w: Tensor) -> None:
        """Store body positions (N, J, 3) m and root rotations (N, 4) xyzw, before resets."""
        self._body_pos_w[self._rows, self._slots] = body_pos_w
        self._root_rot_w[self._rows, self._slots] = root_rot_w
        self._slots.add_(1).clamp_(max=self._max_steps)

    def finish(self, env_ids: Tensor, fell: Tensor, starts_s: Tensor | None = None) -> None:
        """End the episodes of environments (n,).

        `fell` (n,) bool is True for episodes that ended by a fall; `starts_s` (n,) has each
        `Episode.start_s`.
        """
        if self.complete or env_ids.numel() == 0:
            return
        slots = self._slots.tolist()
        starts = [None] * len(env_ids) if starts_s is None else starts_s.tolist()
        for env, has_fallen, start_s in zip(env_ids.tolist(), fell.tolist(), starts, strict=True):
            if self._left[env] == 0:
                continue
            num_steps = slots[env]
            if not self._waiting[env] and num_steps > 0:
                steps = (env, slice(num_steps))
                # The next episode overwrites the buffers.
                copies = (
                    part[steps].clone().cpu() for part in (self._body_pos_w, self._root_rot_w)
                )
                track = Track(*copies)
                poses = root_relative_pose(track.body_pos_w, track.root_rot_w)
                self.episodes.append(Episode(poses, bool(has_fallen), track, start_s))
                self._left[env] -= 1
            self._waiting[env] = False
            self._slots[env] = 0 if self._left[env] else self._max_steps


@dataclass(frozen=True, eq=False)
class ImitationResult:
    """The result of `PoseErrorMetric`; a value is nan if no episode could be measured."""

    pose_error_m: float  # mean of `per_episode` in m, over the episodes that could be measured
    # (E,) m, pose error of each episode; nan if a pose of the episode is not finite.
    per_episode: npt.NDArray[np.float64]
    # (E,) index of each episode's nearest clip, or -1 if its entry in `per_episode` is nan.
    nearest_clip: npt.NDArray[np.int64]
    # Mean number of reference frames per step: the clip's tempo is 1, a frozen pose has 0, and the
    # largest value is about 2. A low pose error means little if the tempo is near 0. If the clip's
    # poses are nearly alike, the measured tempo is nearer to 1 than the true tempo.
    tempo: float
    # Share of the episodes that ended without a fall, 0 to 1. An episode that could not be measured
    # counts as a fall.
    no_fall_share: float
    mean_episode_steps: float  # mean length in control steps
    num_episodes: int  # E
    # Share of the clips' motion that the episodes show, 0 to 1, see `motion_coverage`; nan if this
    # share was not measured.
    motion_shown: float = math.nan
    # The time in the clips at which most falls begin, or None if the falls have no common time.
    fall_moment: FallMoment | None = None

    def __str__(self) -> str:
        shown = "" if math.isnan(self.motion_shown) else f", {self.motion_shown:.0%} of the motion"
        error = f"pose error {self.pose_error_m:.3f} m at tempo {self.tempo:.2f}"
        return f"{error}{shown}, {self.no_fall_share:.0%} without a fall"

    def falls(self) -> str:
        """Return a text with the share of episodes without a fall and the mean length."""
        return (
            f"{self.no_fall_share:.0%} of {self.num_episodes} episodes without a fall, "
            f"{self.mean_episode_steps:.0f} steps on average"
        )


class PoseErrorMetric:
    """Measures the pose error of episodes relative to their nearest reference clips.

    The clips are sampled at the episodes' control step. `max_steps` is the length of an episode
    without an early end, which the coverage needs. If `max_steps` is None, the coverage is not
    measured.
    """

    def __init__(
        self,
        reference: ReferencePoses,
        coverage: MotionCoverage | None = None,
        max_steps: int = 300,
    ) -> None:
        self.reference = reference
        self._coverage = coverage
        self._max_steps = max_steps

    def evaluate(self, episodes: Sequence[Episode]) -> ImitationResult:
        """Measure E >= 1 episodes.

        Raises:
            ValueError: the shape of the poses differs from the shape of the reference poses.
        """
        if not episodes:
            raise ValueError("there is no episode to measure; record at least one")
        expected = (self.reference.num_bodies, 3)
        for episode in episodes:
            if episode.poses.shape[1:] != expected or len(episode.poses) == 0:
                raise ValueError(
                    f"an episode has poses {tuple(episode.poses.shape)}; expected (T, J, 3) with"
                    f" T >= 1 and the reference's J = {self.reference.num_bodies}"
                )
        errors = np.full(len(episodes), np.nan)
        nearest = np.full(len(episodes), -1, dtype=np.int64)
        lengths = np.array([len(episode.poses) for episode in episodes])
        finite = [bool(episode.poses.isfinite().all()) for episode in episodes]
        measurable = np.flatnonzero(finite)
        for clip_id, clip in enumerate(self.reference.clips):
            for ids, found in _aligned(episodes, measurable, clip):
                nearer = ~(errors[ids] <= found.mean_cost)
                errors[ids[nearer]] = found.mean_cost[nearer]
                nearest[ids[nearer]] = clip_id
        no_fall = [ok and not episode.fell for ok, episode in zip(finite, episodes, strict=True)]
        return ImitationResult(
            pose_error_m=_mean(errors[measurable]),
            per_episode=errors,
            nearest_clip=nearest,
            tempo=_mean(self._tempos(episodes, nearest)[measurable]),
            no_fall_share=float(np.mean(no_fall)),
            mean_episode_steps=float(lengths.mean()),
            num_episodes=len(episodes),
            **self._coverage_of([e for e, ok in zip(episodes, finite, strict=True) if ok]),
        )

    def _tempos(
        self, episodes: Sequence[Episode], nearest: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        """Return the tempo (E,) of episodes in their nearest clips (E,); nan where a clip is -1."""
        tempos = np.full(len(episodes), np.nan)
        for clip_id in np.unique(nearest[nearest >= 0]):
            clip = self.reference.clips[clip_id]
            off_tempo_m = _OFF_TEMPO * clip.norm(dim=-1).mean().item()
            of_clip = np.flatnonzero(nearest == clip_id)
            for ids, found in _aligned(episodes, of_clip, clip, off_tempo_m):
                steps = np.array([len(episodes[i].poses) - 1 for i in ids])
                tempos[ids] = found.advance / np.maximum(steps, 1)
        return tempos

    def _coverage_of(self, episodes: Sequence[Episode]) -> dict[str, Any]:
        """Return the share of the clips' motion that episodes show, and the time of most falls."""
        if self._coverage is None:
            return {}
        tracked = [(episode.track, episode) for episode in episodes if episode.track is not None]
        rests = [(track, e.start_s) for track, e in tracked if e.start_s is not None]
        if rests:
            shown = self._coverage.share_of_rest(rests)
        else:
            shown = self._coverage.share([track for track, _ in tracked], self._max_steps)
        fallen = [track for track, episode in tracked if episode.fell]
        return {"motion_shown": shown, "fall_moment": self._coverage.fall_moment(fallen)}


def _mean(values: npt.NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else math.nan


def _aligned(
    episodes: Sequence[Episode],
    ids: npt.NDArray[np.int64],
    clip: Tensor,
    off_tempo_m: float = 0.0,
) -> Iterator[tuple[npt.NDArray[np.int64], Alignment]]:
    """Align the episodes `ids` with a clip (F, J, 3); yield subsets of `ids` with their alignments.

    The episodes of a subset have similar lengths, and their cost tensors fit into `_CHUNK_BYTES`.
    """
    lengths = np.array([len(episodes[i].poses) for i in ids], dtype=np.int64)
    ids = ids[np.argsort(-lengths, kind="stable")]
    while len(ids):
        # Two float32 tensors have the size of the cost tensor: the sum over bodies and the
        # distances of one body.
        size = max(1, _CHUNK_BYTES // (8 * len(clip) * len(episodes[ids[0]].poses)))
        part, ids = ids[:size], ids[size:]
        yield part, _align_with_clip([episodes[i].poses for i in part], clip, off_tempo_m)


def _align_with_clip(episodes: Sequence[Tensor], clip: Tensor, off_tempo_m: float) -> Alignment:
    """Align episodes [(T_e, J, 3)] with a clip (F, J, 3), repeated as often as necessary."""
    lengths = np.array([len(poses) for poses in episodes])
    # (T, E, J, 3), padded with zeros, which `align` ignores.
    padded = torch.nn.utils.rnn.pad_sequence(list(episodes))
    num_rows, num_episodes, num_bodies, _ = padded.shape
    cost = torch.zeros(num_rows, len(clip), num_episodes)
    for body in range(num_bodies):
        frames = clip[:, body].expand(num_rows, -1, -1)
        # The matrix product would turn small distances into noise of 0.3 mm.
        cost += torch.cdist(frames, padded[:, :, body], compute_mode="donot_use_mm_for_euclid_dist")
    cost /= num_bodies
    # An episode may start at any frame of the clip and then have the tempo `_MAX_TEMPO`.
    num_columns = len(clip) + _MAX_TEMPO * (lengths - 1)
    return align(cost.numpy(), lengths, num_columns, off_tempo_m)
