"""A motion clip in memory: poses and velocities of one skeleton at a constant frame rate."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion import kinematics
from isaacgymenvs_lite.motion.kinematics import FloatArray

MIN_FPS, MAX_FPS = 0.1, 10_000.0
MAX_PLACE_M = 10_000.0
"""From the origin: beyond it single precision has steps of 1 mm."""
_MAX_BONE_M = 10.0
MAX_SPEED_M_S = 1_000.0
MAX_SPEED_RAD_S = 100_000.0
MAX_JOINT_RAD = 1_000.0  # 160 turns of a wheel's hinge
# How far the length of a stored quaternion may be from 1.
UNIT_TOLERANCE = 1e-3
# Fewer repeated pairs than this are a character at rest, not data stored twice.
_MIN_REPEATED_PAIRS = 2
# Array -> largest absolute value of a number in it, unit.
_LIMITS = {
    "root_translation": (MAX_PLACE_M, "m"),
    "local_translation": (_MAX_BONE_M, "m"),
    "dof_pos": (MAX_JOINT_RAD, "rad"),
    "linear_velocity_w": (MAX_SPEED_M_S, "m/s"),
    "angular_velocity_w": (MAX_SPEED_RAD_S, "rad/s"),
}


@dataclass(frozen=True, eq=False)
class MotionClip:
    """T >= 2 frames of a skeleton with J bodies; z up, quaternions xyzw, arrays of floats.

    Attributes:
        name: the source of the clip: its path, or `deepmimic:<name>`.
        fps: frames per second.
        body_names: J names, root first.
        parent_indices: J body ids, -1 for the root; parents come before children.
        local_translation: (J, 3) m, origin of a body in its parent's frame (root: not used); or
            (T, J, 3) where joints are beside the origins of their bodies, which they then move.
        local_rotation: (T, J, 4), rotation of a body relative to its parent (root: to the world).
        root_translation: (T, 3) m, world position of the root.
        linear_velocity_w: (T, J, 3) m/s, of the bodies' origins in the world.
        angular_velocity_w: (T, J, 3) rad/s, in the world.
        dof_pos: (T, D) rad, joint coordinates in the order of the `Skeleton`: rotation vectors of
            ball joints, angles of hinges, of any size. None: the rotations of the bodies determine
            them. Rotations do not if a body has several joints, or a hinge turns beyond pi.
    """

    name: str
    fps: float
    body_names: tuple[str, ...]
    parent_indices: tuple[int, ...]
    local_translation: FloatArray
    local_rotation: FloatArray
    root_translation: FloatArray
    linear_velocity_w: FloatArray
    angular_velocity_w: FloatArray
    dof_pos: FloatArray | None = None

    @property
    def num_frames(self) -> int:
        """The number of frames T."""
        return len(self.local_rotation)

    @property
    def num_bodies(self) -> int:
        """The number of bodies J."""
        return len(self.body_names)

    @property
    def length_s(self) -> float:
        """The duration from the first to the last frame, (T - 1) / fps, in s."""
        return (self.num_frames - 1) / self.fps

    @classmethod
    def from_poses(
        cls,
        name: str,
        fps: float,
        body_names: Sequence[str],
        parent_indices: Sequence[int],
        local_translation: FloatArray,
        local_rotation: FloatArray,
        root_translation: FloatArray,
        dof_pos: FloatArray | None = None,
    ) -> MotionClip:
        """Make a clip from poses; velocities by differences, smoothed as poselib does.

        Arguments as the attributes of the class. Raises MotionFileError, see `validate`.
        """
        still = np.zeros((*np.shape(local_rotation)[:2], 3))
        clip = cls(
            name=name,
            fps=float(fps),
            body_names=tuple(body_names),
            parent_indices=tuple(int(parent) for parent in parent_indices),
            local_translation=np.asarray(local_translation),
            local_rotation=np.asarray(local_rotation),
            root_translation=np.asarray(root_translation),
            linear_velocity_w=still,
            angular_velocity_w=still,
            dof_pos=None if dof_pos is None else np.asarray(dof_pos),
        )
        clip.validate()
        positions, turns = clip.global_poses()
        clip = dataclasses.replace(
            clip,
            linear_velocity_w=kinematics.linear_velocities(positions, clip.fps),
            angular_velocity_w=kinematics.angular_velocities(turns, clip.fps),
        )
        clip._check_sizes()
        return clip

    def timed_arrays(self) -> dict[str, FloatArray]:
        """Return the arrays with one row per frame, by the names of their attributes."""
        keys = ["local_rotation", "root_translation", "linear_velocity_w", "angular_velocity_w"]
        keys += ["local_translation"] if np.ndim(self.local_translation) == 3 else []
        keys += ["dof_pos"] if self.dof_pos is not None else []
        return {key: np.asarray(getattr(self, key)) for key in keys}

    def global_poses(self) -> tuple[FloatArray, FloatArray]:
        """Return the world positions (T, J, 3) m and rotations (T, J, 4) of all bodies, float64."""
        return kinematics.forward_kinematics(
            self.parent_indices, self.local_translation, self.local_rotation, self.root_translation
        )

    def validate(self) -> None:
        """Check that the clip can be used.

        Raises:
            MotionFileError: arrays do not fit together, not one root, a child before its parent,
                fewer than two frames, NaN or infinity, quaternions that are not of unit length
                (1e-3); a frame rate, place, bone or speed that no motion has.
        """
        self._check_shapes()
        self._check_tree()
        if self.num_frames < 2:
            raise MotionFileError(
                f"{self.name}: holds {self.num_frames} frame(s), expected at least 2: "
                "a single pose has no duration"
            )
        check_fps(self.name, self.fps)
        self._check_values()

    def find_repeated_frames(self) -> int | None:
        """Find whether every pose is stored twice in a row.

        Returns:
            The index, 0 or 1, of the first frame that is followed by its own copy (1: the clip
            starts with the second of a pair), or None.
        """
        same = (self.local_rotation[1:] == self.local_rotation[:-1]).all(axis=(1, 2))
        same &= (self.root_translation[1:] == self.root_translation[:-1]).all(axis=1)
        if same.all():
            return None  # The character does not move: no frame is a copy rather than a pose.
        for first in (0, 1):
            pairs = same[first::2]
            if len(pairs) >= _MIN_REPEATED_PAIRS and pairs.all():
                return first
        return None

    def drop_repeated_frames(self) -> MotionClip:
        """Return the clip without the copies, at half the fps, if every pose is stored twice.

        Stored velocities are kept: they were smoothed over many frames and are correct. A clip
        without copies is returned unchanged.
        """
        first = self.find_repeated_frames()
        if first is None:
            return self
        keep = np.arange(first, self.num_frames, 2)
        if first == 1:
            keep = np.concatenate(([0], keep))
        kept = {key: values[keep] for key, values in self.timed_arrays().items()}
        return dataclasses.replace(self, fps=self.fps / 2.0, **kept)

    def _check_shapes(self) -> None:
        frames, bodies = len(np.atleast_1d(self.local_rotation)), self.num_bodies
        expected = {
            "parent_indices": (bodies,),
            "local_translation": (*(frames,) * (np.ndim(self.local_translation) == 3), bodies, 3),
            "local_rotation": (frames, bodies, 4),
            "root_translation": (frames, 3),
            "linear_velocity_w": (frames, bodies, 3),
            "angular_velocity_w": (frames, bodies, 3),
        }
        if self.dof_pos is not None:
            expected["dof_pos"] = (frames, np.shape(self.dof_pos)[-1])
        for key, shape in expected.items():
            found = np.shape(getattr(self, key))
            if found != shape:
                raise MotionFileError(
                    f"{self.name}: {key} has shape {found}, expected {shape} "
                    f"for {frames} frames of {bodies} bodies"
                )

    def _check_tree(self) -> None:
        roots = sum(parent < 0 for parent in self.parent_indices)
        if roots != 1:
            raise MotionFileError(f"{self.name}: the skeleton has {roots} roots, expected 1")
        for body, parent in enumerate(self.parent_indices):
            if parent >= body:
                raise MotionFileError(
                    f"{self.name}: body {body} '{self.body_names[body]}' comes before its parent "
                    f"{parent}, expected parents first"
                )
        if len(set(self.body_names)) != self.num_bodies:
            raise MotionFileError(f"{self.name}: body names are not unique: {self.body_names}")

    def _check_values(self) -> None:
        arrays = {"local_translation": self.local_translation, **self.timed_arrays()}
        for key, values in arrays.items():
            check_finite(self.name, key, values)
        self._check_sizes()
        deviation = np.abs(np.linalg.norm(self.local_rotation, axis=-1) - 1.0)
        if deviation.max() > UNIT_TOLERANCE:
            frame, body = (int(i) for i in np.unravel_index(deviation.argmax(), deviation.shape))
            raise MotionFileError(
                f"{self.name}: the rotation of '{self.body_names[body]}' in frame {frame} is no "
                f"unit quaternion (length off by {deviation[frame, body]:.3g}, allowed "
                f"{UNIT_TOLERANCE:g})"
            )

    def _check_sizes(self) -> None:
        for key, (limit, unit) in _LIMITS.items():
            values = getattr(self, key)
            if values is None:
                continue
            # The root's own offset is not used.
            values = values[..., 1:, :] if key == "local_translation" else values
            check_size(self.name, key, float(np.abs(values).max(initial=0.0)), limit, unit)


def check_fps(name: str, fps: float) -> None:
    """Raise a MotionFileError for a frame rate that no motion has."""
    if not MIN_FPS <= fps <= MAX_FPS:
        raise MotionFileError(f"{name}: fps is {fps:g}, expected {MIN_FPS:g} to {MAX_FPS:g}")


def check_finite(name: str, key: str, values: FloatArray) -> None:
    """Raise a MotionFileError for NaN and infinity."""
    finite = np.isfinite(values)
    if not finite.all():
        where = tuple(int(i) for i in np.argwhere(~finite)[0])
        raise MotionFileError(
            f"{name}: {key} holds {np.count_nonzero(~finite)} number(s) that are NaN or infinite, "
            f"the first at index {where}"
        )


def check_size(name: str, key: str, largest: float, limit: float, unit: str) -> None:
    """Raise a MotionFileError for a value that no motion has: a wrong unit, or a damaged file."""
    if largest > limit:
        raise MotionFileError(
            f"{name}: {key} has {largest:.4g} {unit}, expected at most {limit:g} {unit}; is its "
            "unit another one?"
        )
