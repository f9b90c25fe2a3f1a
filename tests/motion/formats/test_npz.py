import dataclasses
from pathlib import Path

import numpy as np
import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.npz import load_npz, save_npz


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_round_trip_is_bit_exact(tmp_path: Path, tiny_clip: MotionClip, dtype) -> None:
    rotation = tiny_clip.local_rotation.astype(dtype)
    clip = dataclasses.replace(tiny_clip, local_rotation=rotation, fps=29.97)
    path = save_npz(tmp_path / "clip", clip)
    assert path.name == "clip.npz"
    loaded = load_npz(path)
    for field in dataclasses.fields(MotionClip):
        before, after = getattr(clip, field.name), getattr(loaded, field.name)
        if isinstance(before, np.ndarray):
            assert before.dtype == after.dtype
            np.testing.assert_array_equal(before, after)
        elif field.name != "name":  # The name of a loaded clip is its path.
            assert before == after


@pytest.mark.parametrize(
    ("stored", "read"),
    [(">f4", "f4"), (">f8", "f8"), ("<f2", "f4"), (np.longdouble, "f8")],
)
def test_other_floats_are_converted(tmp_path: Path, tiny_clip: MotionClip, stored, read) -> None:
    arrays = _arrays(tmp_path, tiny_clip)
    for key in ("local_rotation", "root_translation", "local_translation"):
        arrays[key] = arrays[key].astype(stored)
    np.savez(tmp_path / "other.npz", **arrays)
    clip = load_npz(tmp_path / "other.npz")
    assert clip.local_rotation.dtype == np.dtype(read)
    assert clip.local_rotation.dtype.isnative
    np.testing.assert_allclose(clip.local_rotation, tiny_clip.local_rotation, atol=1e-3)
    np.testing.assert_array_equal(clip.root_translation, tiny_clip.root_translation)


def test_what_no_reader_needs_is_not_unpacked(tmp_path: Path, tiny_clip: MotionClip) -> None:
    path = tmp_path / "clip.npz"
    np.savez(path, **_arrays(tmp_path, tiny_clip), notes=np.array([{}], dtype=object))
    assert load_npz(path).num_frames == tiny_clip.num_frames


def test_file_holds_plain_arrays_only_and_no_time_stamp(tmp_path: Path, tiny_clip) -> None:
    path = save_npz(tmp_path / "a.npz", tiny_clip)
    with np.load(path, allow_pickle=False) as archive:
        assert all(archive[key].dtype != object for key in archive.files)
    assert path.read_bytes() == save_npz(tmp_path / "b.npz", tiny_clip).read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "b.npz"]


def test_missing_velocities_are_computed(tmp_path: Path, tiny_clip: MotionClip) -> None:
    arrays = _arrays(tmp_path, tiny_clip)
    del arrays["linear_velocity_w"], arrays["angular_velocity_w"]
    # x = 0, 2, 4 m at 10 fps.
    arrays["root_translation"] = np.array([[0.0, 0, 0], [2.0, 0, 0], [4.0, 0, 0]])
    np.savez(tmp_path / "clip.npz", **arrays)
    clip = load_npz(tmp_path / "clip.npz")
    np.testing.assert_allclose(clip.linear_velocity_w[:, 0, 0], 20.0, rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fps": None}, "lacks fps; found angular_velocity_w, body_names"),
        ({"version": np.array(2)}, "format version 2, this program reads 1"),
        ({"local_rotation": np.zeros((3, 3, 4), dtype=int)}, "local_rotation holds int64"),
        ({"body_names": np.arange(3)}, "body_names holds int64, expected strings"),
        ({"fps": np.ones(2)}, r"fps has shape \(2,\), expected one number"),
        ({"root_translation": np.zeros((2, 3))}, r"root_translation has shape \(2, 3\)"),
        ({"parent_indices": np.array([{}], dtype=object)}, "Object arrays cannot be loaded"),
    ],
)
def test_bad_content_is_refused(tmp_path: Path, tiny_clip, changes, message: str) -> None:
    arrays = _arrays(tmp_path, tiny_clip) | changes
    path = tmp_path / "bad.npz"
    np.savez(path, **{key: array for key, array in arrays.items() if array is not None})
    _expect_error(path, message)


def test_damaged_files_are_refused(tmp_path: Path, tiny_clip: MotionClip) -> None:
    whole = save_npz(tmp_path / "whole.npz", tiny_clip).read_bytes()
    path = tmp_path / "bad.npz"
    for content in (b"", b"text", whole[: len(whole) // 2], whole[:200] + b"x" * 20 + whole[220:]):
        path.write_bytes(content)
        _expect_error(path, "no .npz archive")
    with path.open("wb") as stream:
        np.save(stream, np.zeros(3))
    _expect_error(path, "single array")
    path.unlink()
    _expect_error(path, "no such file")


def test_invalid_clip_is_not_written(tmp_path: Path, tiny_clip: MotionClip) -> None:
    with pytest.raises(MotionFileError, match="fps is -1"):
        save_npz(tmp_path / "clip.npz", dataclasses.replace(tiny_clip, fps=-1.0))
    assert list(tmp_path.iterdir()) == []


def _arrays(folder: Path, clip: MotionClip) -> dict:
    with np.load(save_npz(folder / "template.npz", clip), allow_pickle=False) as archive:
        return {key: archive[key] for key in archive.files}


def _expect_error(path: Path, message: str) -> None:
    with pytest.raises(MotionFileError, match=message) as raised:
        load_npz(path)
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)
