from __future__ import annotations

import importlib.util
import json
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.formats import deepmimic
from isaacgymenvs_lite.motion.formats.deepmimic import find_in_package
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.motion.skeleton import Skeleton
from tests.packages import needs

# Zero joints: the soles are 0.421546 + 0.409870 + 0.05 m under the pelvis.
SOLE_DEPTH_M = 0.881416


def frame(
    duration_s: float = 0.1, x: float = 0.0, height: float = 1.0, z: float = 0.0
) -> list[float]:
    """Return a frame of 44 numbers with all joints at zero."""
    upright = [1.0, 0.0, 0.0, 0.0]
    leg, arm = [*upright, 0.0, *upright], [*upright, 0.0]
    return [duration_s, x, height, z, *upright, *upright, *upright, *leg, *arm, *leg, *arm]


def walk() -> dict:
    """Three frames of 0.1 s, 0.1 m forward each, 1 m up and 0.3 m to the right."""
    return {"Loop": "wrap", "Frames": [frame(x=0.1 * i, z=0.3) for i in range(3)]}


def test_root_moves_forward_and_up(humanoid: Skeleton) -> None:
    clip = deepmimic.clip_from_deepmimic(walk(), humanoid, "walk")
    assert clip.fps == pytest.approx(10.0)
    # x forward, y up, z to the right become x forward, y to the left, z up.
    expected = [[0.0, -0.3, 1.0], [0.1, -0.3, 1.0], [0.2, -0.3, 1.0]]
    np.testing.assert_allclose(clip.root_translation, expected, atol=1e-12)
    # 0.1 m per 0.1 s.
    np.testing.assert_allclose(clip.linear_velocity_w[:, 0], [[1.0, 0.0, 0.0]] * 3, atol=1e-9)


def test_joint_rotations_change_axes(humanoid: Skeleton) -> None:
    data = walk()
    half = 0.2
    for row in data["Frames"]:
        # By 0.4 rad about: the hip z (to the right), the neck y (up), the left shoulder x.
        row[16:20] = [np.cos(half), 0.0, 0.0, np.sin(half)]
        row[12:16] = [np.cos(half), 0.0, np.sin(half), 0.0]
        row[39:43] = [np.cos(half), np.sin(half), 0.0, 0.0]
        row[20], row[34], row[29], row[43] = -0.5, -0.6, 0.7, 0.8  # knees and elbows
    clip = deepmimic.clip_from_deepmimic(data, humanoid, "walk")

    def rotation(body: str) -> np.ndarray:
        return clip.local_rotation[1, clip.body_names.index(body)]

    turn = {"sin": np.sin(half), "cos": np.cos(half)}
    expected = {
        "right_thigh": [0.0, -turn["sin"], 0.0, turn["cos"]],
        "head": [0.0, 0.0, turn["sin"], turn["cos"]],
        "left_upper_arm": [turn["sin"], 0.0, 0.0, turn["cos"]],
        "right_shin": [0.0, np.sin(0.25), 0.0, np.cos(0.25)],
        "left_shin": [0.0, np.sin(0.3), 0.0, np.cos(0.3)],
        "right_lower_arm": [0.0, np.sin(-0.35), 0.0, np.cos(0.35)],
        "left_lower_arm": [0.0, np.sin(-0.4), 0.0, np.cos(0.4)],
        "right_hand": [0.0, 0.0, 0.0, 1.0],
        "left_thigh": [0.0, 0.0, 0.0, 1.0],
    }
    for body, quaternion in expected.items():
        np.testing.assert_allclose(rotation(body), quaternion, atol=1e-12, err_msg=body)
    # A hip that turns to the front lifts the shin forward: 0.4 rad about -y.
    positions, _ = clip.global_poses()
    knee = positions[1, clip.body_names.index("right_shin")]
    hip = positions[1, clip.body_names.index("right_thigh")]
    swing = 0.421546 * np.array([np.sin(0.4), 0.0, -np.cos(0.4)])
    np.testing.assert_allclose(knee - hip, swing, atol=1e-6)


def test_hands_and_what_they_hold_keep_their_zero_pose(humanoid: Skeleton, armed: Skeleton) -> None:
    plain = deepmimic.clip_from_deepmimic(walk(), humanoid, "walk")
    clip = deepmimic.clip_from_deepmimic(walk(), armed, "walk")
    assert clip.body_names == armed.body_names
    for body, name in enumerate(armed.body_names):
        if name in humanoid.body_names:
            of_plain = plain.local_rotation[:, humanoid.body_names.index(name)]
            np.testing.assert_array_equal(clip.local_rotation[:, body], of_plain, err_msg=name)
        else:
            assert name in ("sword", "shield")
            assert (clip.local_rotation[:, body] == [0.0, 0.0, 0.0, 1.0]).all(), name


def test_clip_below_the_ground_is_lifted_by_a_constant(humanoid: Skeleton, caplog) -> None:
    data = {"Frames": [frame(height=0.85), frame(height=0.80), frame(height=0.95)]}
    with caplog.at_level(logging.INFO):
        clip = deepmimic.clip_from_deepmimic(data, humanoid, "walk")
    lift = SOLE_DEPTH_M - 0.80
    expected = np.array([0.85, 0.80, 0.95]) + lift
    np.testing.assert_allclose(clip.root_translation[:, 2], expected, atol=1e-6)
    assert "walk: lifted by 0.081 m" in caplog.text


def test_a_foot_that_goes_through_the_ground_does_not_lift_the_rest_into_the_air(
    humanoid: Skeleton,
) -> None:
    heights = np.full(60, SOLE_DEPTH_M)
    heights[30] -= 0.08  # less than a 20th of the frames
    data = {"Frames": [frame(height=height) for height in heights]}
    clip = deepmimic.clip_from_deepmimic(data, humanoid, "crawl")
    np.testing.assert_allclose(clip.root_translation[:, 2], heights, atol=1e-6)


def test_unequal_durations_are_resampled(humanoid: Skeleton, caplog) -> None:
    times_s = [0.0, 0.1, 0.2, 0.4, 0.5]
    rows = [frame(x=t) for t in times_s]
    for row, duration in zip(rows, [0.1, 0.1, 0.2, 0.1, 0.0], strict=True):
        row[0] = duration
    for row, t in zip(rows, times_s, strict=True):
        row[20] = -t  # the right knee bends by 1 rad/s
    with caplog.at_level(logging.INFO):
        clip = deepmimic.clip_from_deepmimic({"Frames": rows}, humanoid, "walk")
    # 0.5 s in steps of the usual 0.1 s.
    assert clip.fps == pytest.approx(10.0)
    even = np.arange(6) / 10.0
    np.testing.assert_allclose(clip.root_translation[:, 0], even, atol=1e-12)
    knee = clip.local_rotation[:, clip.body_names.index("right_shin")]
    np.testing.assert_allclose(2.0 * np.arcsin(knee[:, 1]), even, atol=1e-12)
    assert "resampled to 10.00 Hz" in caplog.text


def test_bad_files_are_one_line(tmp_path: Path, humanoid) -> None:
    stopped, nan = walk(), walk()
    stopped["Frames"][1][0], nan["Frames"][1][2] = 0.0, float("nan")
    path = tmp_path / "clip.txt"
    for text, message in (
        ("walk!", "no JSON text"),
        ("[1]", "a JSON list"),
        (json.dumps({"Loop": "wrap"}), "'Frames' with rows of 44 numbers, found the keys Loop"),
        (json.dumps({"Frames": [frame()]}), "holds 1 frame"),
        (json.dumps(stopped), "frame 1 lasts 0 s"),
        (json.dumps(nan), "the frames hold nan"),
    ):
        path.write_text(text)
        with pytest.raises(MotionFileError, match=message) as raised:
            deepmimic.load_deepmimic(path, humanoid)
        assert str(raised.value).startswith(str(path))
        assert "\n" not in str(raised.value)


def test_rows_of_other_robots(tmp_path: Path, humanoid) -> None:
    for suffix in ("txt", "json"):
        path = tmp_path / f"clip.{suffix}"
        path.write_text(json.dumps({"Frames": [[0.5] * 19] * 3}))
        with pytest.raises(
            MotionFileError, match=r"found rows of 19 numbers.*convert it with robot=FILE"
        ):
            load_clips(path, humanoid)


def test_round_trip(tmp_path: Path, humanoid: Skeleton) -> None:
    clip = load_clips("jump")[0][0]
    path = deepmimic.save_deepmimic(tmp_path / "clip.txt", clip)
    again = deepmimic.load_deepmimic(path, humanoid)
    # Numbers are stored to 1e-9, the clips are float32 (6e-8), quaternions are normalised.
    assert again.fps == pytest.approx(clip.fps, rel=1e-6)
    np.testing.assert_allclose(again.global_poses()[0], clip.global_poses()[0], atol=2e-6)


def test_a_hinge_turns_the_other_way(tmp_path: Path, humanoid, make_humanoid_clip, about) -> None:
    clip = make_humanoid_clip(num_frames=3)
    clip.local_rotation[:, humanoid.body_names.index("right_shin")] = about("y", [0.5] * 3)
    rows = json.loads(deepmimic.save_deepmimic(tmp_path / "clip.txt", clip).read_text())["Frames"]
    assert [row[20] for row in rows] == pytest.approx([-0.5] * 3)
    assert rows[0][0] == pytest.approx(1 / 30)
    assert rows[0][2] == pytest.approx(0.9)  # y is up


def test_the_armed_humanoid_loses_its_hand_only(
    tmp_path: Path, armed, make_humanoid_clip, about
) -> None:
    clip = make_humanoid_clip(num_frames=3, skeleton=armed)
    clip.local_rotation[:, armed.body_names.index("right_hand")] = about("x", [0.3] * 3)
    clip.local_rotation[:, armed.body_names.index("torso")] = about("z", [0.2] * 3)
    again = deepmimic.load_deepmimic(deepmimic.save_deepmimic(tmp_path / "clip.txt", clip), armed)
    lost = armed.body_names.index("right_hand")
    others = [body for body in range(armed.num_bodies) if body != lost]
    np.testing.assert_allclose(again.local_rotation[:, others], clip.local_rotation[:, others])
    np.testing.assert_array_equal(again.local_rotation[:, lost], [[0.0, 0.0, 0.0, 1.0]] * 3)


WALKS = ["humanoid3d_walk", "walker/0walk_forward"]
TURNS = [f"walker/turn_{side}" for side in ("left0", "left1", "right0", "right1")]
needs_the_package = needs("pybullet_data")


@pytest.fixture
def make_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Return a maker of a stand-in for pybullet_data that holds clips of two standing frames."""
    upright = [1.0, 0.0, 0.0, 0.0]
    leg, arm = [*upright, 0.0, *upright], [*upright, 0.0]
    frame = [0.1, 0.0, 1.0, 0.0, *upright, *upright, *upright, *leg, *arm, *leg, *arm]

    def make(*names: str) -> Path:
        motions = tmp_path / "pybullet_data" / "data" / "motions"
        (motions / "walker").mkdir(parents=True)
        (tmp_path / "pybullet_data" / "__init__.py").write_text("raise RuntimeError('imported')")
        for name in (*names, "laikago_walk"):
            (motions / f"{name}.txt").write_text(json.dumps({"Frames": [frame, frame]}))
        monkeypatch.syspath_prepend(tmp_path)
        return motions

    return make


def test_clips_are_found_without_importing_the_package(make_package) -> None:
    make_package("humanoid3d_walk", "walker/turn_left0")
    for name in ("humanoid3d_walk", "walk"):
        (clip, weight), *others = load_clips(f"deepmimic:{name}")
        assert (clip.name, weight, others) == ("deepmimic:humanoid3d_walk", 1.0, [])
    choices = "data sets: all, locomotion; clips: humanoid3d_walk, walker/turn_left0$"
    message = f"data set 'wlk' \\(did you mean 'walk'\\?\\); {choices}"
    with pytest.raises(MotionFileError, match=message):
        load_clips("deepmimic:wlk")


def test_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MotionFileError, match=r'pip install "isaacgymenvs-lite\[motions\]"'):
        load_clips("deepmimic:walk")


def test_kinds_of_locomotion_weigh_the_same(make_package) -> None:
    make_package(*WALKS, *TURNS, "humanoid3d_run", "humanoid3d_jump")
    weights = {clip.name: clip.weight for clip in find_in_package("deepmimic:locomotion")}
    # A third for walking (two clips), turning (four clips) and running (one clip) each.
    expected = dict.fromkeys(WALKS, 1 / 6) | dict.fromkeys(TURNS, 1 / 12)
    expected["humanoid3d_run"] = 1 / 3
    assert weights == pytest.approx({f"deepmimic:{name}": w for name, w in expected.items()})


def test_all_takes_every_humanoid_and_new_clips_as_kinds_of_their_own(make_package) -> None:
    make_package("humanoid3d_dance_a", "humanoid3d_dance_b", "humanoid3d_run", "humanoid3d_swim")
    weights = {clip.name: clip.weight for clip in find_in_package("deepmimic:all")}
    expected = {"dance_a": 1 / 6, "dance_b": 1 / 6, "run": 1 / 3, "swim": 1 / 3}
    assert weights == pytest.approx(
        {f"deepmimic:humanoid3d_{name}": w for name, w in expected.items()}
    )


def test_set_of_the_package_shares_the_weight_of_its_entry(make_package, tmp_path: Path) -> None:
    make_package("humanoid3d_run", "humanoid3d_jump")
    path = tmp_path / "set.yaml"
    path.write_text(
        'motions: [{file: "deepmimic:all", weight: 4}, {file: "deepmimic:run", weight: 1}]'
    )
    found = [(clip.name.rpartition("_")[2], weight) for clip, weight in load_clips(path)]
    assert found == [("jump", 2.0), ("run", 2.0), ("run", 1.0)]


@needs_the_package
@pytest.mark.parametrize(
    ("name", "num_clips", "num_kinds", "num_dofs", "num_keys"),
    [("locomotion", 7, 3, 31, 6), ("all", 20, 9, 28, 4)],
)
def test_real_data_sets_give_finite_states(
    name: str, num_clips: int, num_kinds: int, num_dofs: int, num_keys: int
) -> None:
    lib = MotionLib(f"deepmimic:{name}", num_dofs, range(num_keys), "cpu")
    assert lib.num_motions() == num_clips
    run = [lib.get_motion(i).name for i in range(num_clips)].index("deepmimic:humanoid3d_run")
    torch.manual_seed(0)
    ids = lib.sample_motions(9000)
    # Running is the only clip of its kind: it has the whole share of the kind, within 5 sigma.
    share = (ids == run).float().mean().item()
    assert share == pytest.approx(1 / num_kinds, abs=5 * np.sqrt(1 / (num_kinds * 9000)))
    state = lib.get_motion_state(ids, lib.sample_time(ids))
    for key, values in state._asdict().items():
        assert torch.isfinite(values).all(), key
    assert state.dof_pos.shape == (9000, num_dofs)
    assert state.key_pos.shape == (9000, num_keys, 3)
    # No body is under the ground or flies; the fastest joints move at some 20 rad/s.
    assert 0.1 < state.root_pos[:, 2].min() < state.root_pos[:, 2].max() < 1.3
    assert state.dof_vel.abs().max() < 50.0


@needs_the_package
def test_the_locomotion_clips_go_where_their_names_say() -> None:
    for clip, _ in load_clips("deepmimic:locomotion"):
        # Heading of the pelvis' x axis, first and last frame, rad.
        x, y, z, w = clip.local_rotation[[0, -1], 0].T
        first, last = np.arctan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z))
        turn_deg = np.rad2deg((last - first + np.pi) % (2 * np.pi) - np.pi)
        side = 1.0 if "left" in clip.name else -1.0
        if "turn" in clip.name:
            assert side * turn_deg > 20.0, clip.name
        else:
            assert abs(turn_deg) < 10.0, clip.name
        assert clip.root_translation[-1, 0] - clip.root_translation[0, 0] > 0.7, clip.name
