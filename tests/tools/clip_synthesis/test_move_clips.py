"""The planned moves that ship, measured, and the data set that lists all clips."""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.loader import load_clips, shipped_motions, shipped_motions_dir
from isaacgymenvs_lite.motion.mirror import mirror_clip
from isaacgymenvs_lite.motion.skeleton import Skeleton
from tools.clip_synthesis import checks, model_checks
from tools.clip_synthesis.catalogue import clip_names
from tools.clip_synthesis.moves.move_data import MIRRORED, MOVES
from tools.clip_synthesis.report import turn_rad

DATASET = "locomotion"
MAX_BYTES = 1_500_000
REACHES = [name for name in MOVES if name.startswith("reach")]


@cache
def shipped(name: str) -> MotionClip:
    return load_clips(name)[0][0]


@pytest.fixture(params=[*MOVES, *MIRRORED])
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def clip(name: str) -> MotionClip:
    return shipped(name)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(paths.assets_dir() / "mjcf/amp_humanoid.xml"))


def test_feet_stand_still_on_the_ground(clip: MotionClip, humanoid: Skeleton) -> None:
    feet = checks.foot_figures(clip, humanoid)
    assert feet.worst_slip_m < 0.01
    assert feet.deepest_m < 0.005


def test_swinging_feet_clear_the_ground(name: str, clip: MotionClip, humanoid: Skeleton) -> None:
    clearance_m = checks.foot_figures(clip, humanoid).swing_clearance_m
    if name == "stand" or name in REACHES:
        assert np.isnan(clearance_m)
    else:
        assert 0.02 < clearance_m < 0.2


def test_joints_stay_within_their_limits(clip: MotionClip, humanoid: Skeleton) -> None:
    assert checks.limit_margin(clip, humanoid) > np.radians(2.0)
    assert checks.peak_joint_speed(clip, humanoid) < 15.0


def test_joint_speeds_change_smoothly(clip: MotionClip, humanoid: Skeleton) -> None:
    """From frame to frame, at 30 fps, the trunk by 2 rad/s at most and the legs by 16.

    The walk from published tables reaches 12 rad/s in a frame of half that time.
    """
    speeds = np.diff(checks.dof_positions(clip, humanoid), axis=0) * clip.fps
    steps = np.abs(np.diff(speeds, axis=0))
    assert steps[:, :6].max() < 2.0  # abdomen and neck
    assert steps.max() < 16.0


def test_bodies_do_not_touch_each_other(
    clip: MotionClip, humanoid: Skeleton, model: mujoco.MjModel
) -> None:
    assert model_checks.deepest_self_contact(clip, humanoid, model) == 0.0


def test_ground_never_pulls(clip: MotionClip, humanoid: Skeleton, model: mujoco.MjModel) -> None:
    force = model_checks.ground_force(clip, humanoid, model)
    assert force[:, 2].min() > -0.01
    assert force[:, 2].max() < 2.6
    # The feet would slip with a friction of 1 where the force leans by more than 45 degrees.
    aside = np.hypot(force[:, 0], force[:, 1])
    standing = humanoid.sole_corners(*clip.global_poses())[1:-1, ..., 2].min(axis=(1, 2)) < 1e-3
    assert (aside - np.maximum(force[:, 2], 0.3))[standing].max() < 0.0


def test_pressure_is_under_the_feet(
    name: str, clip: MotionClip, humanoid: Skeleton, model: mujoco.MjModel
) -> None:
    """The limbs' momentum included; for single frames of a swing it may lie beside the sole.

    Quick turns and steps aside are made of little but swings.
    """
    quick = any(word in name for word in ("fast", "about", "diagonal_back"))
    outside_m = model_checks.pressure_outside(clip, humanoid, model)
    assert np.nanmean(outside_m) < (0.007 if quick else 0.005)
    assert np.nanmean(outside_m > 0.03) < (0.15 if quick else 0.05)


def test_velocities_are_those_of_the_motion(clip: MotionClip) -> None:
    positions, _ = clip.global_poses()
    velocities = np.gradient(positions, axis=0) * clip.fps
    difference = (velocities - clip.linear_velocity_w)[1:-1]
    assert np.abs(difference).max() < 1e-4


def test_clip_starts_above_the_origin(clip: MotionClip) -> None:
    np.testing.assert_allclose(clip.root_translation[0, :2], 0.0, atol=1e-6)
    assert clip.find_repeated_frames() is None
    assert clip.fps == 30.0
    assert 1.5 <= clip.length_s <= 4.0


# Along x, in which the plan of a move begins to face, along y, and how far the root turns left.
@pytest.mark.parametrize(
    ("name", "forward_m", "left_m", "turn_deg"),
    [
        ("stand", (-0.05, 0.05), (-0.05, 0.05), (-5, 5)),
        ("start_walking", (1.5, 3.0), (-0.1, 0.1), (-10, 10)),
        ("stop_walking", (1.2, 3.0), (-0.1, 0.1), (-10, 10)),
        ("walk_backward", (-2.6, -2.3), (-0.1, 0.1), (-10, 10)),
        ("sidestep_left", (-0.05, 0.05), (1.1, 1.3), (-5, 5)),
        ("turn_left", (-0.15, 0.15), (-0.15, 0.15), (130, 155)),
        ("turn_left_fast", (-0.15, 0.15), (-0.15, 0.15), (255, 270)),
        ("about_turn_left", (-0.7, -0.5), (-0.1, 0.1), (185, 200)),
        ("diagonal_left", (1.6, 1.9), (1.2, 1.5), (-5, 5)),
        ("diagonal_back_left", (-1.5, -1.2), (1.0, 1.3), (-5, 5)),
        ("step_forward", (0.3, 0.6), (-0.05, 0.05), (-5, 5)),
        ("step_back", (-0.5, -0.2), (-0.05, 0.05), (-5, 5)),
        ("step_left", (-0.05, 0.05), (0.2, 0.5), (-5, 5)),
        ("crouch_walk", (1.8, 2.8), (-0.1, 0.1), (-10, 10)),
        ("jump", (0.45, 0.55), (-0.01, 0.01), (-1, 1)),
    ],
)
def test_moves_go_where_their_names_say(
    name: str,
    forward_m: tuple[float, float],
    left_m: tuple[float, float],
    turn_deg: tuple[float, float],
) -> None:
    clip = shipped(name)
    x, y, _ = clip.root_translation[-1] - clip.root_translation[0]
    assert forward_m[0] < x < forward_m[1]
    assert left_m[0] < y < left_m[1]
    assert turn_deg[0] < np.degrees(turn_rad(clip)) < turn_deg[1]


@pytest.mark.parametrize(
    ("name", "least_m", "most_m", "turn_deg"),
    [
        ("walk_left", 1.1, 1.3, 129),  # 1 m/s and 45 deg/s: 1.27 m
        ("walk_left_sharp", 0.35, 0.52, 216),  # 0.8 m/s and 90 deg/s: 0.51 m
    ],
)
def test_curved_walk_is_a_circle(name: str, least_m: float, most_m: float, turn_deg: float) -> None:
    """Of the radius that speed and turn give, or less: the body leans in from the feet's path."""
    clip = shipped(name)
    assert np.degrees(turn_rad(clip)) == pytest.approx(turn_deg, abs=10)
    x, y = clip.root_translation[:, :2].T
    # The circle x^2 + y^2 + a x + b y + c = 0 that fits best.
    ones = np.ones_like(x)
    a, b, c = np.linalg.lstsq(np.stack((x, y, ones), axis=-1), -(x**2 + y**2), rcond=None)[0]
    radius_m = np.sqrt(0.25 * (a**2 + b**2) - c)
    assert least_m < radius_m < most_m
    distance_m = np.hypot(x + 0.5 * a, y + 0.5 * b)
    assert np.abs(distance_m - radius_m).max() < 0.05


# Where the right hand is in the middle of the clip, from where the character stands; shoulders are
# 1.3 m high, an arm is 0.5 m long, and the right side is at negative y.
@pytest.mark.parametrize(
    ("name", "hand_m"),
    [
        ("reach_high", (0.0, -0.28, 1.88)),
        ("reach_forward", (0.56, -0.05, 1.20)),
        ("reach_side", (-0.03, -0.69, 1.31)),
        ("reach_across", (0.36, 0.28, 1.23)),
        ("reach_low", (0.25, -0.19, 0.42)),
    ],
)
def test_reaches_put_the_right_hand_where_their_names_say(
    name: str, hand_m: tuple[float, float, float], humanoid: Skeleton
) -> None:
    positions, _ = shipped(name).global_poses()
    hand = positions[:, humanoid.body_names.index("right_hand")]
    np.testing.assert_allclose(hand[len(hand) // 2], hand_m, atol=0.05)
    # Before and after, it hangs beside the thigh.
    assert hand[[0, -1], 2].max() < 0.95


def test_crouch_is_low_and_stand_is_high() -> None:
    assert shipped("crouch_walk").root_translation[:, 2].max() < 0.75
    assert shipped("stand").root_translation[:, 2].min() > 0.86


def test_standing_ends_stand_still() -> None:
    """The weight has hardly begun to shift, or has come to rest, where a clip stands."""
    for name, frame in (
        ("start_walking", 0),
        ("stop_walking", -1),
        ("jump", 0),
        ("jump", -1),
    ):
        assert np.abs(shipped(name).linear_velocity_w[frame]).max() < 0.15


def test_jump_flies_freely(humanoid: Skeleton, model: mujoco.MjModel) -> None:
    clip = shipped("jump")
    low = humanoid.sole_corners(*clip.global_poses())[..., 2].min(axis=(1, 2))
    flying = low > checks.CONTACT_HEIGHT_M
    # Frames with a neighbour on the ground see part of its force.
    inside = flying[1:-1] & flying[2:] & flying[:-2]
    assert 6 <= inside.sum() <= 10
    force = model_checks.ground_force(clip, humanoid, model)[inside]
    assert np.abs(force).max() < 0.02
    assert low.max() > 0.15


def test_all_others_always_stand(name: str, clip: MotionClip, humanoid: Skeleton) -> None:
    if name != "jump":
        assert checks.foot_figures(clip, humanoid).highest_m < 1e-3


@pytest.mark.parametrize("name", ["start_walking", "stop_walking", "walk_left", "crouch_walk"])
def test_arms_swing_against_the_legs(name: str, humanoid: Skeleton) -> None:
    clip = shipped(name)
    positions, turns = clip.global_poses()
    x, y, z, w = turns[:, 0].T
    heading = np.stack((1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)), axis=-1)
    ahead = {
        body: ((positions[:, humanoid.body_names.index(body), :2]) * heading).sum(axis=-1)
        for body in ("right_hand", "left_hand", "right_foot", "left_foot")
    }
    hands = ahead["right_hand"] - ahead["left_hand"]
    feet = ahead["right_foot"] - ahead["left_foot"]
    assert np.corrcoef(hands, feet)[0, 1] < -0.8


@pytest.mark.parametrize(("name", "original"), sorted(MIRRORED.items()))
def test_right_versions_mirror_the_left_ones(name: str, original: str) -> None:
    image, clip = mirror_clip(shipped(original), name), shipped(name)
    np.testing.assert_allclose(image.local_rotation, clip.local_rotation, atol=1e-6)
    np.testing.assert_allclose(image.root_translation, clip.root_translation, atol=1e-6)
    np.testing.assert_allclose(image.linear_velocity_w, clip.linear_velocity_w, atol=1e-5)
    np.testing.assert_allclose(image.angular_velocity_w, clip.angular_velocity_w, atol=1e-5)


def test_data_set_lists_every_clip_once() -> None:
    clips = load_clips(DATASET)
    names = [clip.name.rsplit("/", 1)[-1].removesuffix(".npz") for clip, _ in clips]
    assert sorted(names) == sorted(clip_names())
    assert sorted([*names, DATASET]) == shipped_motions()
    weights = {name: weight for name, (_, weight) in zip(names, clips, strict=True)}
    assert min(weights.values()) > 0.0
    for right, left in MIRRORED.items():
        assert weights[right] == weights[left]


def test_all_clips_are_small() -> None:
    assert sum(path.stat().st_size for path in shipped_motions_dir().iterdir()) < MAX_BYTES
