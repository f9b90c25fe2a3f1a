"""The walks and the run that ship, measured: the figures that docs/shipped_clips.md promises."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.motion import kinematics
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.skeleton import Skeleton
from tools.clip_synthesis import checks, model_checks
from tools.clip_synthesis.gait_data import GAITS, Gait


@pytest.fixture(params=["walk", "run", "walk_slow", "walk_fast"])
def gait(request: pytest.FixtureRequest) -> Gait:
    return GAITS[request.param]


@pytest.fixture
def clip(gait: Gait) -> MotionClip:
    return load_clips(gait.name)[0][0]


@pytest.fixture
def cycle(gait: Gait, clip: MotionClip) -> int:
    return round(gait.period_s * clip.fps)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(paths.assets_dir() / "mjcf/amp_humanoid.xml"))


def test_feet_do_not_skate(clip: MotionClip, humanoid: Skeleton) -> None:
    assert checks.foot_figures(clip, humanoid).worst_slip_m < 0.01


def test_feet_do_not_sink_into_the_ground(clip: MotionClip, humanoid: Skeleton) -> None:
    assert checks.foot_figures(clip, humanoid).deepest_m < 0.005


def test_stance_feet_are_on_the_ground(
    gait: Gait, clip: MotionClip, cycle: int, humanoid: Skeleton
) -> None:
    """From the planned touch-down to the planned toe-off, whatever counts as touching."""
    lowest = humanoid.sole_corners(*clip.global_poses())[..., 2].min(axis=-1)
    for foot, late in ((0, 0.0), (1, 0.5)):
        since = (np.arange(clip.num_frames) / cycle - late) % 1.0
        assert np.abs(lowest[since <= gait.duty, foot]).max() < 0.005


def test_swinging_feet_clear_the_ground(clip: MotionClip, humanoid: Skeleton) -> None:
    # People clear it by about 13 mm in walking (Winter 1992); a centimetre keeps that safe.
    assert checks.foot_figures(clip, humanoid).swing_clearance_m > 0.01


def test_cycles_close(clip: MotionClip, cycle: int) -> None:
    assert (clip.num_frames - 1) % cycle == 0
    turn_rad, place_m = checks.closure_error(clip, cycle)
    assert turn_rad < 1e-3
    assert place_m < 1e-3


def test_velocities_go_on_across_the_seam(clip: MotionClip) -> None:
    """The last frame is the first of the next cycle: float32 leaves no more than rounding."""
    linear_mps, angular_radps = checks.velocity_seam(clip)
    assert linear_mps < 1e-3
    assert angular_radps < 1e-3


def test_velocities_are_those_of_the_motion(clip: MotionClip) -> None:
    positions, _ = clip.global_poses()
    velocities = np.gradient(positions, axis=0) * clip.fps
    # Inside the clip: at its ends np.gradient is one-sided. float32 positions of about 5 m are
    # good to 2e-7 m, times 60 / s.
    difference = (velocities - clip.linear_velocity_w)[1:-1]
    assert np.abs(difference).max() < 1e-4


def test_joint_limits_are_kept(clip: MotionClip, humanoid: Skeleton) -> None:
    assert checks.limit_margin(clip, humanoid) > 0.0


def test_left_mirrors_right(clip: MotionClip, cycle: int) -> None:
    turn_rad, place_m = checks.symmetry_error(clip, cycle)
    assert turn_rad < 1e-3
    assert place_m < 1e-3


def test_clip_starts_at_zero_and_goes_forward(gait: Gait, clip: MotionClip) -> None:
    assert clip.root_translation[0, 0] == pytest.approx(0.0, abs=1e-6)
    advance = clip.root_translation[-1] - clip.root_translation[0]
    assert advance[0] / clip.length_s == pytest.approx(gait.speed_mps, abs=1e-3)
    assert np.abs(advance[1:]).max() < 1e-3


def test_no_frame_is_stored_twice(clip: MotionClip) -> None:
    assert clip.find_repeated_frames() is None


def test_walk_always_stands_and_run_flies(humanoid: Skeleton) -> None:
    walk = checks.foot_figures(load_clips("walk")[0][0], humanoid)
    run = checks.foot_figures(load_clips("run")[0][0], humanoid)
    assert walk.flight_share == 0.0
    assert walk.double_support_share > 0.1
    assert run.flight_share > 0.15
    assert run.double_support_share == 0.0


@pytest.mark.parametrize(
    ("name", "speed_mps", "lowest_m", "range_m", "joint_radps"),
    [("walk", (1.2, 1.5), 0.82, 0.05, 15.0), ("run", (2.7, 3.2), 0.75, 0.09, 25.0)],
)
def test_motion_is_that_of_a_person(
    name: str,
    speed_mps: tuple[float, float],
    lowest_m: float,
    range_m: float,
    joint_radps: float,
    humanoid: Skeleton,
) -> None:
    clip = load_clips(name)[0][0]
    forward = clip.linear_velocity_w[:, 0, 0]
    assert speed_mps[0] < forward.mean() < speed_mps[1]
    assert np.ptp(forward) < 0.5
    height = clip.root_translation[:, 2]
    assert height.min() > lowest_m
    assert 0.02 < np.ptp(height) < range_m
    assert checks.peak_joint_speed(clip, humanoid) < joint_radps


def test_knees_and_elbows_bend_the_right_way(clip: MotionClip, humanoid: Skeleton) -> None:
    dofs = checks.dof_positions(clip, humanoid)
    for name, sign in (("shin", 1.0), ("lower_arm", -1.0)):
        for side in ("right", "left"):
            group = humanoid.dof_body_ids.index(humanoid.body_names.index(f"{side}_{name}"))
            assert (sign * dofs[:, humanoid.dof_offsets[group]]).min() > 0.0


def test_arms_swing_against_the_legs(clip: MotionClip, humanoid: Skeleton) -> None:
    positions, _ = clip.global_poses()
    ahead = {
        name: positions[:, humanoid.body_names.index(name), 0] - positions[:, 0, 0]
        for name in ("right_hand", "right_foot", "left_foot")
    }
    assert np.corrcoef(ahead["right_hand"], ahead["right_foot"])[0, 1] < -0.5
    assert np.corrcoef(ahead["right_hand"], ahead["left_foot"])[0, 1] > 0.5


def test_trunk_stays_upright(clip: MotionClip) -> None:
    _, turns = clip.global_poses()
    x, y = turns[:, 1, 0], turns[:, 1, 1]
    up = 1.0 - 2.0 * (x * x + y * y)
    assert up.min() > np.cos(np.radians(12.0))


def test_ground_gives_what_the_gait_needs(
    clip: MotionClip, humanoid: Skeleton, model: mujoco.MjModel
) -> None:
    """Never a pull; the mean carries the body. Central differences over an impact blur a little."""
    force = model_checks.ground_force(clip, humanoid, model)[:, 2]
    assert force.min() > -0.05
    assert force.max() < 2.6
    assert force.mean() == pytest.approx(1.0, abs=0.05)


def test_run_falls_freely_in_flight(humanoid: Skeleton, model: mujoco.MjModel) -> None:
    clip = load_clips("run")[0][0]
    touching = humanoid.sole_corners(*clip.global_poses())[..., 2] < checks.CONTACT_HEIGHT_M
    flying = np.asarray(~touching.any(axis=(1, 2)))
    # Frames with a neighbour on the ground see part of its force.
    inside = flying[1:-1] & flying[2:] & flying[:-2]
    force = model_checks.ground_force(clip, humanoid, model)[inside]
    assert np.abs(force).max() < 0.1


def test_bodies_do_not_touch_each_other(
    clip: MotionClip, humanoid: Skeleton, model: mujoco.MjModel
) -> None:
    assert model_checks.deepest_self_contact(clip, humanoid, model) == 0.0


def test_accelerations_have_no_jerks(clip: MotionClip, humanoid: Skeleton) -> None:
    velocities = kinematics.joint_velocities(clip.local_rotation, clip.fps)
    trunk = [humanoid.body_names.index(name) for name in ("torso", "head")]
    steps = np.abs(np.diff(velocities[:-1], axis=0))
    assert steps[:, trunk].max() < 1.0
    assert steps.max() < 12.0
