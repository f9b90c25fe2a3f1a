import dataclasses
import logging
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError, MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.npz import save_npz
from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.motion.skeleton import Skeleton

HAND = 2
# Rotation vectors and positions come from float32 quaternions.
ATOL = 2e-6


@pytest.fixture
def tiny_file(tmp_path: Path, tiny_clip: MotionClip) -> Path:
    return save_npz(tmp_path / "tiny.npz", tiny_clip)


@pytest.fixture
def lib(tiny_file: Path, tiny: Skeleton) -> MotionLib:
    return MotionLib(tiny_file, 4, [HAND], "cpu", skeleton=tiny)


@pytest.fixture
def mixed(tmp_path: Path, tiny: Skeleton, tiny_file: Path, tiny_clip: MotionClip) -> MotionLib:
    """Three clips of 0.2 s, 0.1 s and 0.4 s with the weights 3, 0 and 1."""
    save_npz(tmp_path / "still.npz", dataclasses.replace(tiny_clip, fps=20.0))
    save_npz(tmp_path / "slow.npz", dataclasses.replace(tiny_clip, fps=5.0))
    path = tmp_path / "set.yaml"
    path.write_text(
        "motions:\n"
        "- {file: tiny.npz, weight: 3}\n"
        "- {file: still.npz, weight: 0}\n"
        "- {file: slow.npz, weight: 1}\n"
    )
    return MotionLib(path, 4, [HAND], "cpu", skeleton=tiny)


def _expect(actual: torch.Tensor, expected: list[float]) -> None:
    assert actual.dtype == torch.float32
    np.testing.assert_allclose(actual.numpy(), [expected], atol=ATOL)


def test_state_at_a_time(lib: MotionLib) -> None:
    for time_s, root_x, arm_z, hand_y, frame in (
        (0.05, 0.5, 0.05, 0.1, 0),
        (0.175, 1.0 + 0.75 * 3.0, 0.175, 0.2 + 0.75 * 0.4, 1),
        (7.0, 4.0, 0.2, 0.6, 2),  # after the end: the last pose
        (-0.2, -2.0, -0.2, -0.4, 0),  # before the start: backwards through frames 0 and 1
    ):
        state = lib.get_motion_state(torch.tensor([0]), torch.tensor([time_s]))
        _expect(state.root_pos, [root_x, 0.0, 0.0])
        _expect(state.root_rot, [0.0, 0.0, 0.0, 1.0])
        _expect(state.dof_pos, [0.0, 0.0, arm_z, hand_y])
        # Velocities belong to the frame at or before the time.
        _expect(state.root_vel, [10.0 * (frame + 1), 0.0, 0.0])
        _expect(state.root_ang_vel, [0.0, frame + 1.0, 0.0])
        # 0.1 rad and 0.2, then 0.4 rad per 0.1 s; the last frame repeats the one before.
        _expect(state.dof_vel, [0.0, 0.0, 1.0, (2.0, 4.0, 4.0)[frame]])


def test_key_positions_are_interpolated_in_the_world(lib: MotionLib) -> None:
    key_pos = lib.get_motion_state([0], [0.15]).key_pos
    # The hand is 1 m in front of the arm, which has turned by 0.1 and by 0.2 rad.
    start = np.array([1.0 + math.cos(0.1), math.sin(0.1), 1.0])
    end = np.array([4.0 + math.cos(0.2), math.sin(0.2), 1.0])
    np.testing.assert_allclose(key_pos.numpy(), [[0.5 * (start + end)]], atol=ATOL)


def test_body_positions_of_all_bodies(lib: MotionLib) -> None:
    positions = lib.get_body_pos([0, 0], [0.1, 0.05])
    assert positions.shape == (2, 3, 3)
    at_frame = [[1.0, 0.0, 0.0], [1.0, 0.0, 1.0], [1.0 + math.cos(0.1), math.sin(0.1), 1.0]]
    np.testing.assert_allclose(positions[0], at_frame, atol=ATOL)
    np.testing.assert_allclose(positions[1, 1], [0.5, 0.0, 1.0], atol=ATOL)


def test_nearly_equal_frames_give_their_mean(
    tmp_path: Path, tiny: Skeleton, tiny_clip: MotionClip, about
) -> None:
    # Half angles 4e-4 rad apart are below the threshold 0.001 of the original's slerp.
    rotation = tiny_clip.local_rotation.copy()
    rotation[:, 2] = about("y", [0.5, 0.5008, 0.5])
    path = save_npz(tmp_path / "a.npz", dataclasses.replace(tiny_clip, local_rotation=rotation))
    lib = MotionLib(path, 4, [HAND], "cpu", skeleton=tiny)
    for time_s in (0.01, 0.09, 0.12):
        state = lib.get_motion_state([0], [time_s])
        np.testing.assert_allclose(state.dof_pos[0, 3], 0.5004, atol=ATOL)


def test_clips_do_not_mix_and_frame_times_in_float32_find_their_frame(mixed: MotionLib) -> None:
    ids = torch.arange(3).repeat_interleave(3)
    dt = torch.tensor([0.1, 0.05, 0.2])[ids]
    times = dt * torch.tensor([0, 1, 2] * 3)
    state = mixed.get_motion_state(ids, times)
    np.testing.assert_allclose(state.root_pos[:, 0], [0.0, 1.0, 4.0] * 3, atol=1e-5)
    np.testing.assert_allclose(state.root_vel[:, 0], [10.0, 20.0, 30.0] * 3)
    hand_velocity = np.outer([1.0, 2.0, 0.5], [2.0, 4.0, 4.0]).ravel()
    np.testing.assert_allclose(state.dof_vel[:, 3], hand_velocity, rtol=1e-5)


def test_motions_are_sampled_by_weight_from_torchs_generator(mixed: MotionLib) -> None:
    torch.manual_seed(5)
    ids = mixed.sample_motions(20_000)
    counts = torch.bincount(ids, minlength=3)
    assert counts[1] == 0
    # Five standard deviations of sqrt(0.75 * 0.25 / 20000) = 0.003.
    assert counts[0].item() / 20_000 == pytest.approx(0.75, abs=0.015)
    torch.manual_seed(5)
    assert torch.equal(mixed.sample_motions(20_000), ids)
    assert mixed.sample_motions(0).shape == (0,)


def test_times_are_uniform_in_the_clip(mixed: MotionLib) -> None:
    torch.manual_seed(6)
    ids = torch.tensor([0, 1, 2]).repeat(5000)
    times = mixed.sample_time(ids).view(5000, 3)
    assert times.dtype == torch.float32
    assert (times >= 0.0).all()
    assert (times <= torch.tensor([0.2, 0.1, 0.4])).all()
    # Five standard deviations of the mean of 5000: length / sqrt(12 * 5000) = 0.004 length.
    half = torch.tensor([0.1, 0.05, 0.2])
    np.testing.assert_allclose(times.mean(dim=0) / half, 1.0, atol=0.04)


def test_truncated_times_stop_early_and_never_below_zero(mixed: MotionLib) -> None:
    ids = torch.tensor([0, 1, 2]).repeat(1000)
    times = mixed.sample_time(ids, truncate_time=0.15).view(1000, 3)
    assert (times[:, 0] <= 0.05).all()
    assert (times[:, 1] == 0.0).all()  # the clip of 0.1 s is shorter than 0.15 s
    assert (times[:, 2] <= 0.25).all()
    with pytest.raises(ConfigError, match="truncate_time is -1"):
        mixed.sample_time(ids, truncate_time=-1.0)


def test_times_in_proportion_to_the_motion(tmp_path: Path, humanoid, make_humanoid_clip) -> None:
    """A clip of 2 s whose last half second moves three times as fast, and a clip at rest."""
    clip = make_humanoid_clip(61)
    root = np.array(clip.root_translation)
    speed_m_s = np.where(np.arange(61) < 45, 1.0, 3.0)
    root[:, 0] = np.cumsum(speed_m_s) / 30.0
    save_npz(tmp_path / "fast.npz", dataclasses.replace(clip, root_translation=root))
    root = np.tile(root[:1], (61, 1))
    save_npz(tmp_path / "rest.npz", dataclasses.replace(clip, root_translation=root))
    path = tmp_path / "set.yaml"
    path.write_text("motions:\n- {file: fast.npz, weight: 1}\n- {file: rest.npz, weight: 1}\n")
    lib = MotionLib(path, 28, [5], "cpu")
    torch.manual_seed(0)
    ids = torch.tensor([0, 1]).repeat(20_000)
    times = lib.sample_moving_time(ids).view(20_000, 2)
    assert times.min() >= 0.0
    assert times.max() <= 2.0
    # 1.5 m of 1.5 + 1.5 m; standard deviation sqrt(0.25 / 20000) = 0.0035.
    assert (times[:, 0] > 1.5).float().mean().item() == pytest.approx(0.5, abs=0.03)
    assert (times[:, 1] > 1.5).float().mean().item() == pytest.approx(0.25, abs=0.02)


def _doubled(clip: MotionClip) -> MotionClip:
    frames = np.repeat(np.arange(clip.num_frames), 2)
    return dataclasses.replace(
        clip,
        fps=2.0 * clip.fps,
        local_rotation=clip.local_rotation[frames],
        root_translation=clip.root_translation[frames],
        linear_velocity_w=clip.linear_velocity_w[frames],
        angular_velocity_w=clip.angular_velocity_w[frames],
    )


def test_repeated_frames_are_kept_with_a_warning(
    tmp_path: Path, tiny: Skeleton, tiny_clip: MotionClip, caplog
) -> None:
    path = save_npz(tmp_path / "doubled.npz", _doubled(tiny_clip))
    with caplog.at_level(logging.INFO):
        lib = MotionLib(path, 4, [HAND], "cpu", skeleton=tiny)
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert "alternate between 0 and twice the true speed" in record.getMessage()
    assert "repair_repeated_frames=True" in record.getMessage()
    # The true speeds are 2 and 4 rad/s; frames are at 20 fps.
    speeds = lib.get_motion_state([0] * 4, [0.0, 0.05, 0.1, 0.15]).dof_vel[:, 3]
    np.testing.assert_allclose(speeds, [0.0, 4.0, 0.0, 8.0], rtol=1e-5, atol=1e-5)


def test_repeated_frames_are_repaired_on_request(
    tmp_path: Path, tiny: Skeleton, tiny_clip: MotionClip, lib: MotionLib, caplog
) -> None:
    path = save_npz(tmp_path / "doubled.npz", _doubled(tiny_clip))
    with caplog.at_level(logging.INFO):
        repaired = MotionLib(path, 4, [HAND], "cpu", repair_repeated_frames=True, skeleton=tiny)
    (record,) = caplog.records
    assert "dropped the copies, 3 frames at 10 Hz remain" in record.getMessage()
    times = torch.linspace(-0.1, 0.3, 9)
    ids = torch.zeros(9, dtype=torch.long)
    for a, b in zip(
        repaired.get_motion_state(ids, times), lib.get_motion_state(ids, times), strict=True
    ):
        assert torch.equal(a, b)


def test_user_mistakes(tiny_file: Path, tiny: Skeleton, lib: MotionLib) -> None:
    with pytest.raises(ConfigError, match="num_dofs is 28, but the skeleton has 4"):
        MotionLib(tiny_file, 28, [HAND], "cpu", skeleton=tiny)
    with pytest.raises(ConfigError, match="key body 3 does not exist, expected ids from 0 to 2"):
        MotionLib(tiny_file, 4, [3], "cpu", skeleton=tiny)
    with pytest.raises(MotionFileError, match="its skeleton lacks pelvis"):
        MotionLib(tiny_file, 28, [5], "cpu")
