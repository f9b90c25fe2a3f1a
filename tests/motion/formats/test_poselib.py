import json
import pickletools
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.poselib import (
    clip_from_poselib,
    load_poselib_npy,
    save_poselib_npy,
)
from isaacgymenvs_lite.motion.loader import load_clips


@pytest.fixture
def data(tiny_clip: MotionClip, as_poselib) -> dict[str, Any]:
    return as_poselib(tiny_clip)


def test_npy_clip_is_read(tmp_path: Path, save_object_npy, data, tiny_clip: MotionClip) -> None:
    fps = np.array(10, dtype=np.int32)
    path = save_object_npy(tmp_path / "clip.npy", data | {"fps": fps})
    clip = load_poselib_npy(path)
    assert (clip.name, clip.fps) == (str(path), 10.0)
    assert clip.body_names == tiny_clip.body_names
    assert clip.parent_indices == tiny_clip.parent_indices
    assert clip.local_rotation.dtype == np.float32
    np.testing.assert_array_equal(clip.local_rotation, np.float32(tiny_clip.local_rotation))
    np.testing.assert_array_equal(clip.root_translation, tiny_clip.root_translation)
    np.testing.assert_array_equal(clip.linear_velocity_w, tiny_clip.linear_velocity_w)
    np.testing.assert_array_equal(clip.angular_velocity_w, tiny_clip.angular_velocity_w)


def test_names_may_be_an_array(
    tmp_path: Path, save_object_npy, data, tiny_clip: MotionClip
) -> None:
    data["skeleton_tree"]["node_names"] = np.array(tiny_clip.body_names)
    clip = load_poselib_npy(save_object_npy(tmp_path / "clip.npy", data))
    assert clip.body_names == tiny_clip.body_names
    assert all(type(name) is str for name in clip.body_names)


def test_global_rotations_become_local(data, tiny_clip: MotionClip) -> None:
    _, turns = tiny_clip.global_poses()
    data["rotation"] = {"arr": turns, "context": {"dtype": "float64"}}
    clip = clip_from_poselib(data | {"is_local": False}, "clip")
    np.testing.assert_allclose(clip.local_rotation, tiny_clip.local_rotation, atol=1e-12)


def test_json_variant_is_the_same(data, tiny_clip: MotionClip) -> None:
    def encode(array: Any) -> dict[str, Any]:
        array = np.asarray(array)
        flat = array.ravel().tolist()
        return {"__ndarray__": flat, "dtype": str(array.dtype), "shape": list(array.shape)}

    text = json.dumps(data | {"fps": np.array(10)}, default=encode)
    clip = clip_from_poselib(json.loads(text), "clip.json")
    np.testing.assert_array_equal(clip.local_rotation, np.float32(tiny_clip.local_rotation))
    assert clip.fps == 10.0


def test_bad_content_is_one_line(tmp_path: Path, save_object_npy, data) -> None:
    no_numbers = {"arr": ["a"], "context": {"dtype": "float32"}}
    for content, message in (
        (data | {"__name__": "SkeletonState"}, "'SkeletonState' .a single pose.*'SkeletonMotion'"),
        ([data], "__name__ is None, expected 'SkeletonMotion'"),
        (data | {"skeleton_tree": []}, "lacks the key 'node_names'; found nothing"),
        (data | {"rotation": no_numbers}, "rotation holds <U1"),
        (data | {"fps": "fast"}, "no poselib clip .*could not convert"),
        (data | {"fps": 0}, "fps is 0, expected 0.1 to 10000"),
    ):
        path = save_object_npy(tmp_path / "bad.npy", content)
        with pytest.raises(MotionFileError, match=message) as raised:
            load_poselib_npy(path)
        assert str(raised.value).startswith(str(path))
        assert "\n" not in str(raised.value)


PUBLISHED_NAMES = {
    "collections OrderedDict",
    "numpy.core.multiarray _reconstruct",
    "numpy ndarray",
    "numpy dtype",
}


@pytest.fixture
def walk():
    return load_clips("walk")[0][0]


def test_what_is_read_again_differs_by_rounding_only(tmp_path: Path, walk) -> None:
    again = load_poselib_npy(save_poselib_npy(tmp_path / "walk.npy", walk))
    assert again.fps == walk.fps
    assert again.body_names == walk.body_names
    assert again.parent_indices == walk.parent_indices
    # Half a unit in the last place of a float32 below 8 (m, m/s; quaternions are smaller).
    for key in ("local_rotation", "root_translation", "linear_velocity_w", "local_translation"):
        np.testing.assert_allclose(getattr(again, key), getattr(walk, key), atol=2.4e-7)


def test_the_pickle_names_what_old_numpy_knows(tmp_path: Path, walk) -> None:
    data = save_poselib_npy(tmp_path / "walk.npy", walk).read_bytes()
    start = data.index(b"\n") + 1  # behind numpy's header
    instructions = list(pickletools.genops(data[start:]))
    names = {str(argument) for code, argument, _ in instructions if code.name == "GLOBAL"}
    assert names == PUBLISHED_NAMES
    assert not any(code.name == "STACK_GLOBAL" for code, _, _ in instructions)


def test_numpy_itself_reads_it_as_poselib_does(tmp_path: Path, walk) -> None:
    path = save_poselib_npy(tmp_path / "walk.npy", walk)
    script = (
        "import sys, numpy as np; d = np.load(sys.argv[1], allow_pickle=True).item();"
        "assert d['__name__'] == 'SkeletonMotion' and d['is_local'] is True and d['fps'] == 60;"
        "r = d['rotation']; assert r['arr'].dtype == r['context']['dtype'] == 'float32';"
        "t = d['skeleton_tree']; assert list(t['node_names'])[:2] == ['pelvis', 'torso'];"
        "assert t['parent_indices']['arr'].dtype == 'int64'"
    )
    subprocess.run([sys.executable, "-c", script, str(path)], check=True)


def test_a_fraction_of_fps_stays(tmp_path: Path, make_humanoid_clip) -> None:
    path = save_poselib_npy(tmp_path / "clip.npy", make_humanoid_clip(fps=29.97))
    assert load_poselib_npy(path).fps == 29.97
