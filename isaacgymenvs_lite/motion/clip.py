"""Motion clips with a constant frame rate: `MotionClip` (body poses), `JointClip` (joint angles).

A robot's clip file is read into a `JointClip`. The robot's kinematics converts this `JointClip`
into a `MotionClip`.
"""

from __future__ import annotations

import dataclasses
import logging
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from isaacgymenvs_lite.errors import MotionFileError, listed
from isaacgymenvs_lite.motion import kinematics
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.utils import rotations

_log = logging.getLogger(__name__)

MIN_FPS, _MAX_FPS = 0.1, 10_000.0
MAX_PLACE_M = 10_000.0
"""Largest coordinate (m). In single precision, larger coordinates have steps of 1 mm."""
_MAX_BONE_M = 10.0
_MAX_SPEED_M_S = 1_000.0
_MAX_SPEED_RAD_S = 100_000.0
MAX_JOINT_RAD = 1_000.0  # 160 rotations of a wheel's hinge
_UNIT_TOLERANCE = 1e-3  # largest error of a stored quaternion's length
# A clip with fewer repeated pairs of frames counts as a character at rest.
_MIN_REPEATED_PAIRS = 2
# Maps the name of an array to the largest allowed absolute value and the unit.
_LIMITS = {
    "root_translation": (MAX_PLACE_M, "m"),
    "local_translation": (_MAX_BONE_M, "m"),
    "dof_pos": (MAX_JOINT_RAD, "rad"),
    "linear_velocity_w": (_MAX_SPEED_M_S, "m/s"),
    "angular_velocity_w": (_MAX_SPEED_RAD_S, "rad/s"),
}
QuatOrder = Literal["xyzw", "wxyz"]
QUAT_ORDERS: tuple[QuatOrder, ...] = ("xyzw", "wxyz")
# Values above which `oddities` reports a clip. The fastest joints of the robot G1 reach 37 rad/s.
_ODD_JOINT_SPEED_RAD_S, _ODD_ROOT_SPEED_M_S = 60.0, 15.0
_ODD_JOINT_RAD, _ODD_HEIGHT_M = 10.0, 20.0
# Angles that exceed a joint's limits by this much are not in radians.
_MAX_EXCESS_RAD = 2.0 * np.pi
# A root is upright if its upward axis is within 60 degrees of the world's z.
_UPRIGHT_COSINE = 0.5
UP: tuple[float, ...] = (0.0, 0.0, 1.0)
_HAND_WORDS = {"hand", "finger", "thumb", "index", "middle", "ring", "pinky", "little", "gripper"}
_SUFFIX = re.compile(r"(_joint|_dof)+$")


@dataclass(frozen=True, eq=False)
class MotionClip:
    """T >= 2 frames of a skeleton with J bodies. z is up, and quaternions are xyzw.

    Attributes:
        name: the path of the clip, or `deepmimic:<name>`.
        fps: frames per second.
        body_names: J names; the first name is the root's.
        parent_indices: J body ids, -1 for the root; parents come before children.
        local_translation: (J, 3) m, origins of the bodies in their parents' frames; the root's row
            is not used. The shape is (T, J, 3) if a joint that is not at a body's origin moves the
            origin.
        local_rotation: (T, J, 4), rotations of the bodies relative to their parents, and of the
            root relative to the world.
        root_translation: (T, 3) m, world position of the root.
        linear_velocity_w: (T, J, 3) m/s, world velocities of the bodies' origins.
        angular_velocity_w: (T, J, 3) rad/s, in the world frame.
        dof_pos: (T, D) rad, joint coordinates in the `Skeleton`'s order: rotation vectors of ball
            joints and angles of hinges. The value is None if the bodies' rotations determine the
            joint coordinates, which requires one joint per body and hinge angles within pi.
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
        """The duration (T - 1) / fps in s from the first to the last frame."""
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
        """Make a clip from poses; the velocities are smoothed differences, as in poselib.

        The class docstring describes the arguments, and `validate` describes the errors.
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
        """Return a dictionary from attribute names to the arrays that have one row per frame."""
        keys = ["local_rotation", "root_translation", "linear_velocity_w", "angular_velocity_w"]
        keys += ["local_translation"] if np.ndim(self.local_translation) == 3 else []
        keys += ["dof_pos"] if self.dof_pos is not None else []
        return {key: np.asarray(getattr(self, key)) for key in keys}

    def global_poses(self) -> tuple[FloatArray, FloatArray]:
        """Return world positions (T, J, 3) m and rotations (T, J, 4) of all bodies in float64."""
        return kinematics.forward_kinematics(
            self.parent_indices, self.local_translation, self.local_rotation, self.root_translation
        )

    def validate(self) -> None:
        """Raise a MotionFileError for a clip that cannot be used.

        The checks concern shapes, the tree of bodies, the number of frames (at least 2), NaN and
        infinity, the lengths of quaternions (1 within 1e-3), and the ranges of fps, lengths and
        speeds.
        """
        frames, bodies = len(np.atleast_1d(self.local_rotation)), self.num_bodies
        moving = (frames,) * (np.ndim(self.local_translation) == 3)
        shapes = {
            "parent_indices": (bodies,),
            "local_translation": (*moving, bodies, 3),
            "local_rotation": (frames, bodies, 4),
            "root_translation": (frames, 3),
            "linear_velocity_w": (frames, bodies, 3),
            "angular_velocity_w": (frames, bodies, 3),
        }
        if self.dof_pos is not None:
            shapes["dof_pos"] = (frames, np.shape(self.dof_pos)[-1])
        _check_shapes(self, shapes, f"{frames} frames of {bodies} bodies")
        self._check_tree()
        if frames < 2:
            raise MotionFileError(
                f"{self.name}: holds {frames} frame(s), expected at least 2: "
                "a single pose has no duration"
            )
        _check_fps_and_finite(self, ["local_translation", *self.timed_arrays()])
        self._check_sizes()
        if (found := _not_unit(self.local_rotation)) is not None:
            (frame, body), problem = found
            raise MotionFileError(
                f"{self.name}: the rotation of '{self.body_names[body]}' in frame {frame} {problem}"
            )

    def find_repeated_frames(self) -> int | None:
        """Return the first frame (0 or 1) that equals the next frame if each pose is stored twice.

        If poses are not stored twice, return None.
        """
        same = (self.local_rotation[1:] == self.local_rotation[:-1]).all(axis=(1, 2))
        same &= (self.root_translation[1:] == self.root_translation[:-1]).all(axis=1)
        if same.all():
            return None  # The character does not move.
        for first in (0, 1):
            pairs = same[first::2]
            if len(pairs) >= _MIN_REPEATED_PAIRS and pairs.all():
                return first
        return None

    def drop_repeated_frames(self) -> MotionClip:
        """If every pose is stored twice, return the clip without the copies, at half the fps.

        Stored velocities are kept, because they are correct in spite of the copies.
        """
        first = self.find_repeated_frames()
        if first is None:
            return self
        keep = np.arange(first, self.num_frames, 2)
        if first == 1:
            keep = np.concatenate(([0], keep))
        kept = {key: values[keep] for key, values in self.timed_arrays().items()}
        return dataclasses.replace(self, fps=self.fps / 2.0, **kept)

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

    def _check_sizes(self) -> None:
        for key, (limit, unit) in _LIMITS.items():
            values = getattr(self, key)
            if values is None:
                continue
            # The root's offset is not used.
            values = values[..., 1:, :] if key == "local_translation" else values
            _check_size(self.name, key, float(np.abs(values).max(initial=0.0)), limit, unit)


def _check_shapes(clip: MotionClip | JointClip, shapes: dict[str, Any], what: str) -> None:
    """Raise a MotionFileError if an array does not have the expected shape."""
    for key, shape in shapes.items():
        found = np.shape(getattr(clip, key))
        if found != shape:
            raise MotionFileError(
                f"{clip.name}: {key} has shape {found}, expected {shape} for {what}"
            )


def _check_fps_and_finite(clip: MotionClip | JointClip, keys: Iterable[str]) -> None:
    """Raise a MotionFileError for a frame rate out of range, NaN or infinity."""
    if not MIN_FPS <= clip.fps <= _MAX_FPS:
        raise MotionFileError(
            f"{clip.name}: fps is {clip.fps:g}, expected {MIN_FPS:g} to {_MAX_FPS:g}"
        )
    for key in keys:
        finite = np.isfinite(getattr(clip, key))
        if not finite.all():
            where = tuple(int(i) for i in np.argwhere(~finite)[0])
            raise MotionFileError(
                f"{clip.name}: {key} holds {np.count_nonzero(~finite)} number(s) that are NaN or"
                f" infinite, the first at index {where}"
            )


def _not_unit(quaternions: FloatArray) -> tuple[tuple[int, ...], str] | None:
    """Return the index and error of the quaternion that is farthest from unit length, or None."""
    deviation = np.abs(np.linalg.norm(quaternions, axis=-1) - 1.0)
    if deviation.max() <= _UNIT_TOLERANCE:
        return None
    where = tuple(int(i) for i in np.unravel_index(deviation.argmax(), deviation.shape))
    off = f"length off by {deviation.max():.3g}, allowed {_UNIT_TOLERANCE:g}"
    return where, f"is no unit quaternion ({off})"


def _check_size(name: str, key: str, largest: float, limit: float, unit: str) -> None:
    """Raise a MotionFileError for a value beyond the limit."""
    if largest > limit:
        raise MotionFileError(
            f"{name}: {key} has {largest:.4g} {unit}, expected at most {limit:g} {unit}; check its"
            " unit"
        )


@dataclass(frozen=True, eq=False)
class JointClip:
    """T >= 2 frames of a robot with D joint coordinates. z is up, and quaternions are xyzw."""

    name: str  # the path of the clip
    fps: float  # frames per second
    root_pos: FloatArray  # (T, 3) m, world position of the root body
    root_rot: FloatArray  # (T, 4) xyzw, rotation of the root body relative to the world
    dof_pos: FloatArray  # (T, D) rad, angles of hinges, and rotation vectors of ball joints
    joint_names: tuple[str, ...] | None = None  # D names, or None if the file has no names
    # The order in which the file's quaternions were read, or None if it has no quaternions.
    file_quat_order: QuatOrder | None = "xyzw"

    @property
    def num_frames(self) -> int:
        """The number of frames T."""
        return len(self.dof_pos)

    @property
    def num_dofs(self) -> int:
        """The number of joint coordinates D."""
        return int(np.shape(self.dof_pos)[1])

    def validate(self) -> None:
        """Raise a MotionFileError for a clip that cannot be used (see `MotionClip.validate`)."""
        if np.ndim(self.dof_pos) != 2 or self.num_frames < 2 or self.num_dofs < 1:
            raise MotionFileError(
                f"{self.name}: dof_pos has shape {np.shape(self.dof_pos)}, expected (frames, "
                "joints), at least 2 frames and 1 joint"
            )
        frames, dofs, names = self.num_frames, self.num_dofs, self.joint_names
        shapes = {"root_pos": (frames, 3), "root_rot": (frames, 4)}
        _check_shapes(self, shapes, f"{frames} frames of dof_pos")
        if names is not None and (len(names) != dofs or len(set(names)) != dofs):
            raise MotionFileError(
                f"{self.name}: has {len(names)} names of joints ({len(set(names))} different "
                f"ones), expected one for each of {dofs} columns"
            )
        _check_fps_and_finite(self, ("root_pos", "root_rot", "dof_pos"))
        for what, largest, limit, unit in (
            ("root_pos", np.abs(self.root_pos).max(), MAX_PLACE_M, "m"),
            ("dof_pos", np.abs(self.dof_pos).max(), MAX_JOINT_RAD, "rad"),
            ("the root's speed", self._root_speed().max(), _MAX_SPEED_M_S, "m/s"),
            ("a joint's speed", self._joint_speed().max(), _MAX_SPEED_RAD_S, "rad/s"),
        ):
            _check_size(self.name, what, float(largest), limit, unit)
        if (found := _not_unit(self.root_rot)) is not None:
            raise MotionFileError(f"{self.name}: root_rot of frame {found[0][0]} {found[1]}")

    def _root_speed(self) -> FloatArray:
        """Return the root's speed (T - 1,) in m/s."""
        return np.linalg.norm(np.diff(self.root_pos.astype(np.float64), axis=0), axis=-1) * self.fps

    def _joint_speed(self) -> FloatArray:
        """Return the joints' speeds (T - 1, D) in rad/s."""
        return np.abs(np.diff(self.dof_pos.astype(np.float64), axis=0)) * self.fps

    def oddities(self, up_b: Sequence[float] = UP) -> list[str]:
        """Return a text for each hint at a wrong unit, frame rate or quaternion order.

        `up_b` (3,) is the upward direction in the frame of an upright root.
        """
        found = []
        lying = 1.0 - _upright_share(self.root_rot, up_b)
        if lying > 0.5:
            text = f"the root lies on its side or upside down in {lying:.0%} of the frames"
            for order in QUAT_ORDERS if self.file_quat_order else ():
                if _upright_share(self.reread(order).root_rot, up_b) > 0.5:
                    text += (
                        f", but not if the quaternions of the file are {order}:"
                        f" give quat_order={order} to isaacgymenvs-lite convert"
                    )
            found.append(text)
        root, speeds, angles = self._root_speed().max(), self._joint_speed(), np.abs(self.dof_pos)
        height, check = np.abs(self.root_pos[:, 2]).max(), f"{self.fps:g} fps; check fps and units"
        if root > _ODD_ROOT_SPEED_M_S:
            found.append(f"the root moves at {root:.3g} m/s at {check}")
        if speeds.max() > _ODD_JOINT_SPEED_RAD_S:
            label = self._label(int(speeds.max(axis=0).argmax()))
            found.append(f"{label} turns at {speeds.max():.3g} rad/s at {check}")
        if angles.max() > _ODD_JOINT_RAD:
            label = self._label(int(angles.max(axis=0).argmax()))
            found.append(f"{label} is at {angles.max():.3g} rad; is the unit degrees?")
        if height > _ODD_HEIGHT_M:
            found.append(f"the root is {height:.3g} m high; is the unit cm?")
        return found

    def _label(self, joint: int) -> str:
        return self.joint_names[joint] if self.joint_names else f"joint {joint}"

    def reread(self, quat_order: QuatOrder) -> JointClip:
        """Return the clip with its quaternions reordered as if the file had the order `quat_order`.

        Raises MotionFileError if the file has no quaternions.
        """
        if self.file_quat_order is None:
            raise MotionFileError(
                f"{self.name}: holds no quaternions, which quat_order={quat_order} needs; leave it"
                " out"
            )
        if quat_order == self.file_quat_order:
            return self
        quaternions = torch.from_numpy(np.ascontiguousarray(self.root_rot))
        is_wxyz = quat_order == "wxyz"
        rotation = (rotations.xyzw_from_wxyz if is_wxyz else rotations.wxyz_from_xyzw)(quaternions)
        return dataclasses.replace(self, root_rot=rotation.numpy(), file_quat_order=quat_order)

    def fitted_to(
        self, joint_names: Sequence[str], by_order: bool = False, followers: Sequence[str] = ()
    ) -> JointClip:
        """Return the clip with the joints of a robot in the robot's order.

        Joints are matched by their names without the endings `_joint` and `_dof`. If the file has
        no names or `by_order` is True, joints are matched by their order. Hand joints that only the
        file has are dropped, and hand joints that only the robot has stay at 0 rad. The angles of
        missing `followers`, which other joints determine, are NaN. Raises MotionFileError for any
        other missing or extra joint.
        """
        names = tuple(joint_names)
        if self.joint_names is None or by_order:
            leaders = tuple(name for name in names if name not in followers)
            if self.num_dofs not in (len(names), len(leaders)):
                raise MotionFileError(
                    f"{self.name}: has {self.num_dofs} joints without names, the robot has "
                    f"{len(names)} ({listed(names)}); give a clip of this robot"
                )
            own = names if self.num_dofs == len(names) else leaders
            return dataclasses.replace(self, joint_names=own).fitted_to(names, False, followers)
        ours = {name: i for i, name in enumerate(_comparable(self.joint_names, names))}
        theirs = _comparable(names, self.joint_names)
        absent = [i for i, name in enumerate(theirs) if name not in ours]
        following = [i for i in absent if names[i] in followers]
        missing = [theirs[i] for i in absent if i not in following]
        extra = [name for name in ours if name not in set(theirs)]
        if any(_HAND_WORDS.isdisjoint(name.lower().split("_")) for name in (*missing, *extra)):
            raise MotionFileError(
                f"{self.name}: its joints are not the robot's; only the robot has "
                f"{listed(missing)}; only the file has {listed(extra)}"
                + ("; by_order=True ignores names" if self.num_dofs == len(names) else "")
            )
        for what, joints in (("drops", extra), ("leaves at 0 rad", missing)):
            if joints:
                _log.info("%s: %s the joints of hands %s", self.name, what, listed(joints))
        dof_pos = np.zeros((self.num_frames, len(names)), dtype=self.dof_pos.dtype)
        dof_pos[:, following] = np.nan
        for column, name in enumerate(theirs):
            if name in ours:
                dof_pos[:, column] = self.dof_pos[:, ours[name]]
        return dataclasses.replace(self, dof_pos=dof_pos, joint_names=names)

    def check_limits(self, dof_limits: FloatArray) -> None:
        """Raise a MotionFileError if joints exceed the limits (D, 2) rad by more than 2 pi.

        Such an excess means that the unit is wrong. The module `plausibility` reports smaller
        excesses.
        """
        excess_rad = np.maximum(dof_limits[:, 0] - self.dof_pos, self.dof_pos - dof_limits[:, 1])
        of_joints_rad = np.fmax.reduce(excess_rad)  # ignores NaN from `fitted_to`
        joint = int(np.nanargmax(of_joints_rad))
        worst_rad = float(of_joints_rad[joint])
        if worst_rad <= _MAX_EXCESS_RAD:
            return
        low, high = dof_limits[joint]
        raise MotionFileError(
            f"{self.name}: {self._label(joint)} exceeds its limits ({low:.3g} to {high:.3g} rad) by"
            f" up to {worst_rad:.3g} rad; is the unit degrees?"
        )


def _upright_share(root_rot: FloatArray, up_b: Sequence[float]) -> float:
    """Return the share of rotations (T, 4) after which `up_b` (3,) is within 60 degrees of z."""
    turns = torch.from_numpy(np.ascontiguousarray(root_rot, dtype=np.float64))
    up = torch.tensor(up_b, dtype=torch.float64).expand(len(turns), 3)
    up_w = rotations.quat_apply(turns, up)
    return float((up_w[:, 2] > _UPRIGHT_COSINE).double().mean())


def _comparable(names: Sequence[str], others: Sequence[str]) -> list[str]:
    """Remove the endings of the names; return unchanged names if two names would become equal."""
    short = [_SUFFIX.sub("", name) for name in names]
    other_short = {_SUFFIX.sub("", name) for name in others}
    unique = len(set(short)) == len(names) and len(other_short) == len(others)
    return short if unique else list(names)
