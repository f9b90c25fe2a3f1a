from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.files import check_output, written_clip
from isaacgymenvs_lite.motion.formats.npz import load_npz, save_npz


def test_round_trip_is_bit_exact(tmp_path: Path, tiny_clip: MotionClip) -> None:
    rotation = tiny_clip.local_rotation.astype(np.float32)  # the other arrays are float64
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


def test_other_floats_are_converted(tmp_path: Path, tiny_clip: MotionClip) -> None:
    for stored, read in ((">f4", "f4"), (np.longdouble, "f8")):
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


def _arrays(folder: Path, clip: MotionClip) -> dict:
    with np.load(save_npz(folder / "template.npz", clip), allow_pickle=False) as archive:
        return {key: archive[key] for key in archive.files}


def test_bad_files_are_one_line(tmp_path: Path, tiny_clip: MotionClip) -> None:
    whole = save_npz(tmp_path / "whole.npz", tiny_clip).read_bytes()
    path, arrays = tmp_path / "bad.npz", _arrays(tmp_path, tiny_clip)
    no_archive = "no .npz archive"
    for content, message in (
        (b"text", no_archive),
        (whole[: len(whole) // 2], no_archive),
        (whole[:200] + b"x" * 20 + whole[220:], no_archive),
        ({"version": np.array(2)}, "format version 2, this program reads 1"),
        ({"body_names": np.arange(3)}, "body_names holds int64, expected strings"),
        ({"fps": np.ones(2)}, r"fps has shape \(2,\), expected one number"),
        ({"root_translation": np.zeros((2, 3))}, r"root_translation has shape \(2, 3\)"),
        ({"parent_indices": np.array([{}], dtype=object)}, "Object arrays cannot be loaded"),
    ):
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            changed: dict = arrays | content
            np.savez(path, allow_pickle=True, **changed)
        with pytest.raises(MotionFileError, match=message) as raised:
            load_npz(path)
        assert str(raised.value).startswith(str(path))
        assert "\n" not in str(raised.value)
    np.savez(path, fps=np.array(30.0))
    with pytest.raises(MotionFileError, match="lacks body_names, parent_indices"):
        load_npz(path)
    with path.open("wb") as stream:
        np.save(stream, np.zeros(3))
    with pytest.raises(MotionFileError, match="single array"):
        load_npz(path)


def test_a_folder_that_cannot_be_written_to(tmp_path: Path) -> None:
    path = tmp_path / "none" / "clip.npz"
    with (
        pytest.raises(MotionFileError, match=r"cannot write .*none/clip\.npz \(No such file"),
        written_clip(path) as partial,
    ):
        partial.write_text("")


def test_outputs_are_checked_before_the_work(tmp_path: Path) -> None:
    suffixes = (".npz", ".csv")
    path = tmp_path / "clip.npz"
    check_output(path, suffixes, overwrite=False)
    path.write_text("")
    with pytest.raises(MotionFileError, match="exists already; overwrite=True replaces it"):
        check_output(path, suffixes, overwrite=False)
    check_output(path, suffixes, overwrite=True)
    with pytest.raises(MotionFileError, match=r"found '\.fbx'; choices: \.npz, \.csv"):
        check_output(tmp_path / "clip.fbx", suffixes, overwrite=True)
    with pytest.raises(MotionFileError, match=r"the folder .*none does not exist"):
        check_output(tmp_path / "none" / "clip.npz", suffixes, overwrite=True)
