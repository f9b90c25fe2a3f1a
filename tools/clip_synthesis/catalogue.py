"""Lists all synthesised clips and makes a clip by its name."""

from __future__ import annotations

from dataclasses import dataclass

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.motion.clip import MotionClip
from tools.clip_synthesis.gait_data import RUN, WALK, WALK_FAST, WALK_SLOW, Gait
from tools.clip_synthesis.generate import generate
from tools.clip_synthesis.mirror import mirror_clip
from tools.clip_synthesis.moves.generate import generate_move
from tools.clip_synthesis.moves.move_data import MIRRORED, MOVES


@dataclass(frozen=True)
class GaitClip:
    """A clip that consists of whole cycles of a gait."""

    gait: Gait
    num_cycles: int
    fps: int

    @property
    def frames_per_cycle(self) -> int:
        """The number of frames in one cycle."""
        return round(self.gait.period_s * self.fps)


# IsaacGymEnvs' clips have 60 frames per second, and ASE's clips have 30.
GAIT_CLIPS: dict[str, GaitClip] = {
    "walk": GaitClip(WALK, 4, 60),
    "run": GaitClip(RUN, 5, 60),
    "walk_slow": GaitClip(WALK_SLOW, 3, 30),
    "walk_fast": GaitClip(WALK_FAST, 4, 30),
}


def clip_names() -> list[str]:
    """Return the names of all clips: first periodic gaits, then moves, then mirror images."""
    return [*GAIT_CLIPS, *MOVES, *MIRRORED]


def make_clip(name: str) -> MotionClip:
    """Make the clip with this name.

    Raises:
        ConfigError: there is no such clip.
        MissingPackageError: mink is not installed.
    """
    if name in GAIT_CLIPS:
        entry = GAIT_CLIPS[name]
        return generate(entry.gait, entry.num_cycles, entry.fps)
    if name in MIRRORED:
        return mirror_clip(generate_move(MOVES[MIRRORED[name]]), name)
    if name in MOVES:
        return generate_move(MOVES[name])
    raise ConfigError(unknown("clip", name, clip_names()))
