"""Finds motion in a clip that no body can perform and no policy can imitate.

The checks concern ground contact, flight, joint limits, and the start and end of a clip.
`warn_of_implausible` logs the results, and the clip is used in any case.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import BodyPoses, dofs_of_clip, qpos_from_clip
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.robots.start_pose import (
    CLEARANCE,
    geoms_that_touch,
    posed,
    reach_down,
    start_height,
)
from isaacgymenvs_lite.utils.rotations import rotate_components

_log = logging.getLogger(__name__)

GROUND_QUANTILE = 0.05
"""The ground's height is this quantile of the lowest points of all frames."""
_DEEP_M, _HIGH_M = 0.03, 0.03
_IN_AIR_M = 0.1  # Above this height a clip is in the air; feet in recorded walks reach 8 cm.
# A body touches the ground if it is low in at least `_TOUCH_SHARE` of the frames. Low means below
# `_TOUCH` times the usual height of the centre of mass (3 cm for a human).
_TOUCH, _TOUCH_SHARE = 0.033, 0.02
# A character rolls or lies if its centre of mass is below this share of the usual height.
_LOW_MASS = 0.45
_GRAVITY_M_S2 = 9.81
# Tolerance of the acceleration in flight; recorded jumps fall with 9.6 to 10.8 m/s^2, because the
# body's shape changes in flight.
_FALL_TOLERANCE_M_S2 = 1.2
_FALL_MISFIT_M = 0.02
_HOVERING_M_S2 = 5.0
# Least duration of a flight whose acceleration is estimated.
_FLIGHT_S, _FLIGHT_FRAMES = 0.2, 5
_EXCESS_RAD = 0.1
# In a cycle, the mean distance of the bodies between first and last pose is below this value.
_CLOSED_M = 0.1
# Longer clips are checked at this many evenly spaced frames.
_MAX_FRAMES = 4000
_MAX_NAMED = 5


@dataclass(frozen=True, eq=False)
class _Poses:
    """T frames of a clip, at most `_MAX_FRAMES`."""

    fps: float  # selected frames per second
    # Maps a body id to the heights (T,) m of the body's lowest point that can touch the ground.
    lows_m: dict[int, npt.NDArray[np.float64]]
    mass_height_m: npt.NDArray[np.float64]  # (T,) height of the centre of mass
    body_pos: FloatArray  # (T, J, 3) m; x and y are relative to the root

    @classmethod
    def of(cls, clip: MotionClip, skeleton: Skeleton) -> _Poses | None:
        """Return the poses, or None if no geom can touch the ground."""
        model = skeleton.model
        every = -(-clip.num_frames // _MAX_FRAMES)
        pos, rot = BodyPoses(skeleton).at(qpos_from_clip(skeleton, clip)[::every])
        root = int(model.jnt_bodyid[0])

        def height(body: int, point: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
            """Return the world heights (T,) m of a point in a body's frame."""
            offset = rotate_components(rot[:, body], point.astype(np.float32)[:, None])[2]
            return np.asarray(pos[2, body] + offset, dtype=np.float64)

        lows_m: dict[int, npt.NDArray[np.float64]] = {}
        for geom in geoms_that_touch(model):
            body = int(model.geom_bodyid[geom]) - root
            if 0 <= body < skeleton.num_bodies:
                x, y, z, w = rot[:, body]
                zeros = np.zeros_like(x)
                down = rotate_components((-x, -y, -z, w), (zeros, zeros, zeros - 1.0))
                w, x, y, z = model.geom_quat[geom][:, None]
                down = np.stack(rotate_components((-x, -y, -z, w), down), axis=-1)
                low_m = height(body, model.geom_pos[geom]) - reach_down(model, geom, down)
                lows_m[body] = np.minimum(low_m, lows_m.get(body, np.inf))
        if not lows_m:
            return None
        ids = range(skeleton.num_bodies)
        masses = model.body_mass[root : root + len(ids)]
        heights = np.stack([height(body, model.body_ipos[root + body]) for body in ids])
        body_pos = pos.transpose(2, 1, 0).astype(np.float64)
        body_pos[..., :2] -= body_pos[:, :1, :2]
        mass_height_m = masses @ heights / max(float(masses.sum()), 1e-9)
        return cls(clip.fps / every, lows_m, mass_height_m, body_pos)

    @functools.cached_property
    def lowest_m(self) -> npt.NDArray[np.float64]:
        """(T,) height of the lowest point of all bodies."""
        lowest: npt.NDArray[np.float64] = np.min(list(self.lows_m.values()), axis=0)
        return lowest

    @functools.cached_property
    def ground_m(self) -> float:
        """The height of the ground in the clip."""
        return float(np.quantile(self.lowest_m, GROUND_QUANTILE))


def is_in_air(clip: MotionClip, skeleton: Skeleton) -> bool:
    """Return whether the lowest points of a clip are above the ground."""
    poses = _Poses.of(clip, skeleton)
    return poses is not None and poses.ground_m > _HIGH_M


def put_on_ground(clip: MotionClip, skeleton: Skeleton) -> MotionClip:
    """Return the clip, moved vertically so that its lowest points are on the ground."""
    poses = _Poses.of(clip, skeleton)
    if poses is None:
        return clip
    raised = np.asarray(clip.root_translation) - [0.0, 0.0, poses.ground_m]
    return dataclasses.replace(clip, root_translation=raised.astype(clip.root_translation.dtype))


def bodies_on_ground(clips: Sequence[MotionClip], skeleton: Skeleton) -> list[str]:
    """Return the names of the bodies that touch the ground in clips, in the skeleton's order.

    A body touches the ground if its lowest point is near the ground in at least 2% of a clip's
    frames. The limit is 3 cm for a human, and proportional to the size for robots. If the centre of
    mass comes near the ground, the function returns all bodies, because recorded contacts of rolls
    and crawls are seldom exact.
    """
    # The usual height is the height of the centre of mass above the ground with all joints at rest.
    model = skeleton.model
    qpos = model.qpos0.copy()
    qpos[2] = start_height(model, qpos) - CLEARANCE
    data = posed(model, qpos)
    mujoco.mj_comPos(model, data)
    usual_m = float(data.subtree_com[model.jnt_bodyid[0], 2])
    found: set[int] = set()
    for clip in clips:
        poses = _Poses.of(clip, skeleton)
        if poses is None:
            continue
        above_m = float(np.quantile(poses.mass_height_m, _TOUCH_SHARE)) - poses.ground_m
        if above_m < _LOW_MASS * usual_m:
            return list(skeleton.body_names)
        touch_m = poses.ground_m + _TOUCH * usual_m
        rates = {body: float((low < touch_m).mean()) for body, low in poses.lows_m.items()}
        found.update(body for body, rate in rates.items() if rate >= _TOUCH_SHARE)
    return [skeleton.body_names[body] for body in sorted(found)]


def implausible(clip: MotionClip, skeleton: Skeleton) -> list[str]:
    """Return a short text for each implausible property of a clip."""
    found = [_beyond_limits(clip, skeleton)]
    poses = _Poses.of(clip, skeleton)
    if poses is not None:
        found = [_odd_flight(poses), *found, _ends_in_air(poses)]
        if not -_DEEP_M <= poses.ground_m <= _HIGH_M:
            side = "below" if poses.ground_m < 0 else "above"
            found.insert(
                0,
                f"its lowest points are {abs(poses.ground_m):.2f} m {side} the ground"
                " (task.env.groundClips=True, or isaacgymenvs-lite convert with ground=True, puts"
                " them on it)",
            )
    return [text for text in found if text]


def warn_of_implausible(clips: Sequence[MotionClip], skeleton: Skeleton) -> dict[str, str]:
    """Log up to `_MAX_NAMED` implausible clips; return a dictionary from names to descriptions."""
    found = {clip.name: text for clip in clips if (text := "; ".join(implausible(clip, skeleton)))}
    lines = [f"{name}: implausible: {text}" for name, text in found.items()]
    if len(lines) > _MAX_NAMED:
        lines[_MAX_NAMED:] = [f"{len(lines) - _MAX_NAMED} more clips are implausible"]
    _warn_once(tuple(lines))
    return found


@functools.lru_cache(maxsize=8)
def _warn_once(lines: tuple[str, ...]) -> None:
    """Log lines, but not a second time when a training loads its clips again for the evaluation."""
    for line in lines:
        _log.warning("%s", line)


def _odd_flight(poses: _Poses) -> str:
    """Describe the flight that differs most from a free fall, or return an empty text."""
    is_in_air = poses.lowest_m > poses.ground_m + _IN_AIR_M
    ends = np.flatnonzero(np.diff(is_in_air, prepend=False, append=False)).reshape(-1, 2)
    least = max(_FLIGHT_FRAMES, int(np.ceil(_FLIGHT_S * poses.fps)) + 1)
    worst, text = 0.0, ""
    for start, end in ends:
        if end - start < least:
            continue
        flight = slice(start, end)
        heights = poses.mass_height_m[flight]
        times_s = np.arange(len(heights)) / poses.fps
        parabola = np.polyfit(times_s, heights, 2)
        fall_m_s2 = -2.0 * parabola[0]
        misfit_m = float(np.sqrt(np.mean(np.square(np.polyval(parabola, times_s) - heights))))
        off = abs(fall_m_s2 - _GRAVITY_M_S2)
        if off <= _FALL_TOLERANCE_M_S2 and misfit_m <= _FALL_MISFIT_M:
            continue
        oddness = off / _FALL_TOLERANCE_M_S2 + misfit_m / _FALL_MISFIT_M
        if oddness < worst:
            continue
        start_s, end_s = start / poses.fps, (end - 1) / poses.fps
        high_m = float(poses.lowest_m[flight].max()) - poses.ground_m
        how = (
            f"it hovers up to {high_m:.2f} m above the ground"
            if fall_m_s2 < _HOVERING_M_S2
            else f"its flight is no free fall: {fall_m_s2:.1f} m/s^2, expected {_GRAVITY_M_S2:.1f}"
            f" ({100 * misfit_m:.0f} cm from a parabola)"
        )
        worst, text = oddness, f"{how} ({start_s:.2f} to {end_s:.2f} s)"
    return text


def _beyond_limits(clip: MotionClip, skeleton: Skeleton) -> str:
    dofs = dofs_of_clip(skeleton, clip)
    excess_rad = np.maximum(skeleton.dof_limits[:, 0] - dofs, dofs - skeleton.dof_limits[:, 1])
    joint = int(excess_rad.max(axis=0).argmax())
    worst_rad = float(excess_rad[:, joint].max())
    if worst_rad <= _EXCESS_RAD:
        return ""
    share = float((excess_rad.max(axis=1) > _EXCESS_RAD).mean())
    low, high = skeleton.dof_limits[joint]
    return (
        f"{skeleton.dof_names[joint]} is up to {worst_rad:.2f} rad beyond its limits"
        f" ({low:.2f} to {high:.2f}); joints exceed their limits in {share:.0%} of the frames"
    )


def _ends_in_air(poses: _Poses) -> str:
    """Describe a start or end in the air; return "" if there is none or if the clip is a cycle."""
    difference_m = np.linalg.norm(poses.body_pos[0] - poses.body_pos[-1], axis=-1)
    if difference_m.mean() < _CLOSED_M:
        return ""
    first_m, last_m = (float(poses.lowest_m[at]) - poses.ground_m for at in (0, -1))
    found = []
    if first_m > _IN_AIR_M:
        found.append(f"it starts {first_m:.2f} m in the air")
    if last_m > _IN_AIR_M:
        found.append(f"it ends {last_m:.2f} m in the air and shows no landing")
    return "; ".join(found)
