"""Measures the shipped clips, compares docs/shipped_clips.md, and makes some clips again."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.formats.npz import load_npz
from isaacgymenvs_lite.motion.loader import load_clips, shipped_motions
from isaacgymenvs_lite.motion.skeleton import Skeleton, skeleton_for_num_dofs
from tools.clip_synthesis import __main__ as command
from tools.clip_synthesis import checks, model_checks
from tools.clip_synthesis.catalogue import GAIT_CLIPS, clip_names, make_clip
from tools.clip_synthesis.gait_data import GAITS
from tools.clip_synthesis.generate import generate
from tools.clip_synthesis.mirror import mirror_clip
from tools.clip_synthesis.moves.move_data import MIRRORED, MOVES
from tools.clip_synthesis.report import turn_rad

pytestmark = pytest.mark.slow

# Ranges of the way forward and left in m, and of the turn in degrees, over each clip.
WAYS = {
    "stand": ((-0.05, 0.05), (-0.05, 0.05), (-5, 5)),
    "walk_backward": ((-2.6, -2.3), (-0.1, 0.1), (-10, 10)),
    "sidestep_left": ((-0.05, 0.05), (1.1, 1.3), (-5, 5)),
    "turn_left": ((-0.15, 0.15), (-0.15, 0.15), (130, 155)),
    "jump": ((0.45, 0.55), (-0.01, 0.01), (-1, 1)),
}


@pytest.fixture(scope="module")
def humanoid() -> Skeleton:
    return skeleton_for_num_dofs(28)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(paths.assets_dir() / "mjcf/amp_humanoid.xml"))


def every_clip():
    return ((name, load_clips(name)[0][0]) for name in clip_names())


def test_feet_do_not_skate_or_sink(humanoid: Skeleton) -> None:
    for name, clip in every_clip():
        feet = checks.foot_figures(clip, humanoid)
        assert feet.worst_slip_m < 0.01, name
        assert feet.deepest_m < 0.005, name


def test_joints_stay_within_their_limits(humanoid: Skeleton) -> None:
    for name, clip in every_clip():
        assert checks.limit_margin(clip, humanoid) > 0.0, name


def test_the_ground_never_pulls(humanoid: Skeleton, model: mujoco.MjModel) -> None:
    for name, clip in every_clip():
        force = model_checks.ground_force(clip, humanoid, model)[:, 2]
        assert force.min() > -0.05, name
        assert force.max() < 2.6, name


def test_bodies_do_not_touch_each_other(humanoid: Skeleton, model: mujoco.MjModel) -> None:
    for name, clip in every_clip():
        assert model_checks.deepest_self_contact(clip, humanoid, model) == 0.0, name


def test_the_pressure_is_under_the_feet(humanoid: Skeleton, model: mujoco.MjModel) -> None:
    for name in MOVES:
        outside_m = model_checks.pressure_outside(load_clips(name)[0][0], humanoid, model)
        assert np.nanmean(outside_m) < 0.007, name


def test_velocities_are_differences_of_the_positions() -> None:
    for name, clip in every_clip():
        positions, _ = clip.global_poses()
        velocities = np.gradient(positions, axis=0) * clip.fps
        difference = (velocities - clip.linear_velocity_w)[1:-1]
        assert np.abs(difference).max() < 1e-4, name


@pytest.mark.parametrize("name", sorted(GAIT_CLIPS))
def test_cycles_close_and_mirror(name: str) -> None:
    clip, frames = load_clips(name)[0][0], GAIT_CLIPS[name].frames_per_cycle
    assert (clip.num_frames - 1) % frames == 0
    for error in (checks.closure_error, checks.symmetry_error):
        assert max(error(clip, frames)) < 1e-3
    assert max(checks.velocity_seam(clip)) < 1e-3


def test_a_walk_always_stands_and_a_run_flies(humanoid: Skeleton) -> None:
    walk = checks.foot_figures(load_clips("walk")[0][0], humanoid)
    run = checks.foot_figures(load_clips("run")[0][0], humanoid)
    assert walk.flight_share == 0.0 and walk.double_support_share > 0.1
    assert run.flight_share > 0.15 and run.double_support_share == 0.0


def test_moves_go_where_their_names_say() -> None:
    for name, (forward_m, left_m, turn_deg) in WAYS.items():
        clip = load_clips(name)[0][0]
        x, y, _ = clip.root_translation[-1] - clip.root_translation[0]
        turn = np.degrees(turn_rad(clip))
        for value, (least, most) in ((x, forward_m), (y, left_m), (turn, turn_deg)):
            assert least < value < most, name


def test_right_versions_mirror_the_left_ones() -> None:
    for name, original in MIRRORED.items():
        image, clip = mirror_clip(load_clips(original)[0][0], name), load_clips(name)[0][0]
        np.testing.assert_allclose(image.local_rotation, clip.local_rotation, atol=1e-6)
        np.testing.assert_allclose(image.root_translation, clip.root_translation, atol=1e-6)


def test_the_data_set_lists_every_clip_once() -> None:
    names = [Path(clip.name).stem for clip, _ in load_clips("locomotion")]
    assert sorted(names) == sorted(clip_names())
    assert sorted([*names, "locomotion"]) == shipped_motions()


@pytest.mark.parametrize("name", ["walk", "run", "jump", "walk_right"])
def test_shipped_clips_are_what_the_generator_makes(name: str) -> None:
    pytest.importorskip("mink")
    made, shipped = make_clip(name), load_clips(name)[0][0]
    # The search stops at steps of 1e-8 rad. Other versions of the solver differ within this range.
    np.testing.assert_allclose(made.local_rotation, shipped.local_rotation, atol=1e-4)
    np.testing.assert_allclose(made.root_translation, shipped.root_translation, atol=1e-4)
    np.testing.assert_allclose(made.linear_velocity_w, shipped.linear_velocity_w, atol=1e-2)


def test_the_command_writes_the_chosen_clip(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(command, "make_clip", lambda name: load_clips(name)[0][0])
    assert command.main(["--out", str(tmp_path / "clips"), "--clips", "walk"]) == 0
    assert [path.name for path in (tmp_path / "clips").iterdir()] == ["walk.npz"]
    assert load_npz(tmp_path / "clips" / "walk.npz").name.endswith("walk.npz")


def test_an_odd_cycle_or_an_unknown_clip_is_refused() -> None:
    odd = dataclasses.replace(GAITS["walk"], period_s=55 / 60)
    with pytest.raises(ValueError, match="55 frames at 60 fps, expected an even number"):
        generate(odd, 1)
    with pytest.raises(ConfigError, match=r"unknown clip 'jumq' \(did you mean 'jump'\?\)"):
        make_clip("jumq")
