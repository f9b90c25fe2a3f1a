"""Tests that implausible motion is found in clips, and no other motion."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.convert import ConvertSettings, convert
from isaacgymenvs_lite.motion.formats.npz import load_npz, save_npz
from isaacgymenvs_lite.motion.loader import load_clips, shipped_motions
from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.motion.plausibility import (
    bodies_on_ground,
    implausible,
    put_on_ground,
)
from isaacgymenvs_lite.motion.qpos import clip_from_qpos

FPS = 60.0


@pytest.fixture
def clip_of_heights(humanoid):
    """Return a maker of clips: the zero pose, with the lowest point at heights (T,) m."""

    def make(heights, **joints) -> MotionClip:
        heights = np.asarray(heights, dtype=np.float64)
        qpos = np.zeros((len(heights), humanoid.qpos_addresses[-1]))
        for address, size in zip(humanoid.qpos_addresses, humanoid.dof_sizes, strict=False):
            qpos[:, address] = 1.0 if size == 3 else 0.0
        qpos[:, 3] = 1.0
        for group, values in joints.items():
            qpos[:, humanoid.qpos_addresses[int(group[1:])]] = values
        clip = clip_from_qpos("made up", FPS, humanoid, qpos)
        lowest_m = float(put_on_ground(clip, humanoid).root_translation[0, 2])
        qpos[:, 2] = lowest_m + heights
        return clip_from_qpos("made up", FPS, humanoid, qpos)

    return make


def jump(height_m: float, gravity_m_s2: float = 9.81) -> np.ndarray:
    """Heights of a leap, with half a second on the ground before and after it."""
    half_s = np.sqrt(2.0 * height_m / gravity_m_s2)
    times_s = np.arange(-half_s, half_s, 1.0 / FPS)
    leap = height_m - 0.5 * gravity_m_s2 * times_s**2
    return np.concatenate((np.zeros(30), leap, np.zeros(30)))


def test_a_leap_is_plausible(humanoid, clip_of_heights):
    assert implausible(clip_of_heights(jump(0.4)), humanoid) == []
    assert implausible(clip_of_heights(np.zeros(30)), humanoid) == []


def test_hovering(humanoid, clip_of_heights):
    heights = np.concatenate((np.zeros(30), np.full(30, 0.12), np.zeros(30)))
    (text,) = implausible(clip_of_heights(heights), humanoid)
    assert text == "it hovers up to 0.12 m above the ground (0.50 to 0.98 s)"


def test_off_the_ground(humanoid, clip_of_heights):
    clip, words = clip_of_heights(np.full(60, -0.08)), "0.08 m below"
    (text,) = implausible(clip, humanoid)
    assert text.startswith(f"its lowest points are {words} the ground (task.env.groundClips=True")
    assert implausible(put_on_ground(clip, humanoid), humanoid) == []


def test_it_ends_in_the_air(humanoid, clip_of_heights):
    leap = jump(0.4)
    crouched = np.linspace(0.0, 1.0, len(leap))  # a clip that closes may end in the air
    clip = clip_of_heights(leap, g8=crouched)
    cut = {key: values[: len(leap) // 2] for key, values in clip.timed_arrays().items()}
    assert "it ends 0.4" in implausible(dataclasses.replace(clip, **cut), humanoid)[-1]
    cut = {key: values[len(leap) // 2 :] for key, values in clip.timed_arrays().items()}
    assert "it starts 0.4" in implausible(dataclasses.replace(clip, **cut), humanoid)[-1]


def test_a_joint_beyond_its_limits(humanoid, clip_of_heights):
    knee = humanoid.dof_names.index("right_knee")
    group = humanoid.dof_offsets.index(knee)
    low = humanoid.dof_limits[knee, 0]
    clip = clip_of_heights(np.zeros(60), **{f"g{group}": np.linspace(0.0, low - 0.3, 60)})
    texts = implausible(clip, humanoid)
    assert any(text.startswith("right_knee is up to 0.30 rad beyond its limits") for text in texts)


def test_shipped_clips_are_plausible(humanoid):
    for name in shipped_motions():
        for clip, _ in load_clips(name, humanoid):
            assert implausible(clip, humanoid) == [], name


def test_a_library_says_it_in_one_line_and_its_argument_mends_it(
    tmp_path, humanoid, clip_of_heights, caplog
):
    clip = dataclasses.replace(clip_of_heights(np.full(60, 0.1234)), name=str(tmp_path))
    file = save_npz(tmp_path / "high.npz", clip)
    for _ in range(2):  # once, although a training loads its clips twice
        library = MotionLib(file, 28, [5], "cpu")
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.startswith(f"{file}: implausible: its lowest points are 0.12 m above the ground")
    raised = library.get_motion_state([0], [0.5]).root_pos[0, 2]
    grounded = MotionLib(file, 28, [5], "cpu", ground=True)
    lowered = grounded.get_motion_state([0], [0.5]).root_pos[0, 2]
    assert float(raised - lowered) == pytest.approx(0.1234, abs=1e-5)
    assert len(caplog.records) == 1


def test_convert_puts_a_clip_on_the_ground(tmp_path, humanoid, clip_of_heights, caplog):
    file = save_npz(tmp_path / "deep.npz", clip_of_heights(np.full(60, -0.2)))
    out = tmp_path / "mended.npz"
    convert(str(file), str(out), ConvertSettings(ground=True))
    assert "implausible" not in caplog.text
    assert implausible(load_npz(out), humanoid) == []


def test_bodies_on_the_ground(humanoid, clip_of_heights):
    feet = ["right_foot", "left_foot"]
    assert bodies_on_ground([clip_of_heights(np.zeros(60))], humanoid) == feet
    # The lowest points of a clip above the ground are its ground.
    assert bodies_on_ground([clip_of_heights(np.full(60, 0.4))], humanoid) == feet
    lying = clip_of_heights(np.zeros(60))
    root = np.array(lying.root_translation)
    root[30:, 2] = 0.1
    rolled = dataclasses.replace(lying, root_translation=root)
    assert bodies_on_ground([lying, rolled], humanoid) == feet  # the feet are then deep below
    turns = np.array(lying.local_rotation)
    turns[30:, 0] = (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))  # on the stomach
    rolled = dataclasses.replace(rolled, local_rotation=turns)
    assert bodies_on_ground([lying, rolled], humanoid) == list(humanoid.body_names)


def test_a_robot_beside_other_bodies(robot, moving):
    """Bodies before the robot, and objects after it, do not count."""
    qpos = moving(robot)[:, : robot.qpos_addresses[-1]]
    clip = clip_from_qpos("robot", 30.0, robot, qpos)
    grounded = put_on_ground(clip, robot)
    assert not any("lowest points" in text for text in implausible(grounded, robot))
