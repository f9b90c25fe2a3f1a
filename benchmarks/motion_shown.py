"""Measures the share of the motion, and the tempo, of motions that are known, without simulation.

    python -m benchmarks.motion_shown [--clips shipped deepmimic PATH ...]

Prints the tables of docs/imitation_metric.md: episodes of 10 s of each clip itself, slower and
faster, on the spot, frozen, with smaller movements, and of standing.
"""

from __future__ import annotations

import argparse
import logging
import sys

import torch

from benchmarks import tables
from benchmarks.clips import named_clips
from isaacgymenvs_lite.errors import UserError
from isaacgymenvs_lite.evaluation.body_tracks import Track, tracks_of_clips
from isaacgymenvs_lite.evaluation.motion_coverage import MotionCoverage
from isaacgymenvs_lite.evaluation.pose_error import (
    Episode,
    PoseErrorMetric,
    ReferencePoses,
    root_relative_pose,
)
from isaacgymenvs_lite.motion.motion_lib import MotionLib

DT_S = 1.0 / 30.0
STEPS = 300
_KEY_BODIES = (5, 8, 11, 14)
_PHASES = (0.0, 0.2, 0.4, 0.6, 0.8)
_TEMPOS = (0.5, 0.8, 1.25, 1.5)
# How far bodies move from their mean pose in the clip's heading frame, as a share of the clip's.
_SMALL = 0.3


def library(motion_file: str) -> MotionLib:
    """Return the library of one clip of the humanoid, as tasks make it."""
    return MotionLib(motion_file, 28, _KEY_BODIES, "cpu", True, interpolation="spline")


def played(lib: MotionLib, steps: int = STEPS, phase: float = 0.0, tempo: float = 1.0) -> Track:
    """Return an episode of a clip that goes on from where it ends, beginning at a share of it."""
    length_s = float(lib.get_motion_length([0]))
    times_s = phase * length_s + tempo * DT_S * torch.arange(steps, dtype=torch.float64)
    ids, in_clip_s = torch.zeros(steps, dtype=torch.long), times_s % length_s
    ends = lib.get_motion_state([0, 0], [0.0, length_s]).root_pos
    moved = ends[1] - ends[0]
    moved[2] = 0.0
    repetitions = torch.floor(times_s / length_s).float().view(-1, 1, 1)
    body_pos_w = lib.get_body_pos(ids, in_clip_s) + repetitions * moved
    return Track(body_pos_w, lib.get_motion_state(ids, in_clip_s).root_rot)


def shares(lib: MotionLib, standing: Track) -> dict[str, float]:
    """Return the shares of the motion of one clip by what is played."""
    coverage = MotionCoverage(tracks_of_clips(lib, DT_S), DT_S)
    episode = played(lib)
    on_the_spot = episode.body_pos_w.clone()
    on_the_spot[..., :2] -= episode.body_pos_w[:, :1, :2]
    frozen = [played(lib, steps=1, phase=phase) for phase in _PHASES]
    tracks = {
        "itself": [played(lib, phase=phase) for phase in _PHASES],
        **{f"tempo {tempo}": [played(lib, tempo=tempo)] for tempo in _TEMPOS},
        "on the spot": [Track(on_the_spot, episode.root_rot_w)],
        "standing": [standing],
    }
    measured = {name: coverage.share(episodes, STEPS) for name, episodes in tracks.items()}
    still = [
        Track(one.body_pos_w.expand(STEPS, -1, -1), one.root_rot_w.expand(STEPS, -1))
        for one in frozen
    ]
    return measured | {"frozen": max(coverage.share([one], STEPS) for one in still)}


def tempos(lib: MotionLib, standing: Track) -> dict[str, float]:
    """Return the measured tempos of one clip by what is played."""
    metric = PoseErrorMetric(ReferencePoses.from_tracks(tracks_of_clips(lib, DT_S)))
    rest = metric.reference.clips[0].mean(dim=0)

    def measured(episode: Track, size: float = 1.0) -> float:
        poses = root_relative_pose(episode.body_pos_w, episode.root_rot_w).float()
        return metric.evaluate([Episode(rest + size * (poses - rest), fell=False)]).tempo

    # From a phase between two frames, as episodes are.
    episodes = {tempo: played(lib, phase=0.1, tempo=tempo) for tempo in (1.0, *_TEMPOS)}
    whole = {f"tempo {tempo}": measured(episode) for tempo, episode in episodes.items()}
    small = {f"small, {tempo}": measured(episodes[tempo], _SMALL) for tempo in (0.5, 0.8, 1.0)}
    return whole | small | {"standing": measured(standing)}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--clips", nargs="+", default=["shipped"])
    args = parser.parse_args()
    logging.disable(logging.WARNING)
    try:
        clips = named_clips(args.clips)
        standing = played(library("stand"))
        libraries = {label: library(file) for label, file in clips.items()}
    except UserError as error:
        sys.exit(f"error: {error}")
    for title, measure in {"motion shown": shares, "measured tempo": tempos}.items():
        measured = {label: measure(lib, standing) for label, lib in libraries.items()}
        names = list(next(iter(measured.values())))
        rows = [
            (label, *(f"{numbers[name]:.2f}" for name in names))
            for label, numbers in measured.items()
        ]
        print(f"{title}\n\n{tables.markdown(('clip', *names), rows)}\n")


if __name__ == "__main__":
    main()
