import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.poselib import clip_from_poselib, load_poselib_npy


@pytest.fixture
def data(tiny_clip: MotionClip, as_poselib) -> dict[str, Any]:
    return as_poselib(tiny_clip)


@pytest.mark.parametrize("fps", [10, 10.0, np.float64(10.0), np.array(10, dtype=np.int32)])
def test_npy_clip_is_read(
    tmp_path: Path, save_object_npy, data, tiny_clip: MotionClip, fps
) -> None:
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


def _drop(key: str) -> Callable[[dict], Any]:
    return lambda data: {k: v for k, v in data.items() if k != key}


def _change(**changes: Any) -> Callable[[dict], Any]:
    return lambda data: data | changes


_NUMBERS = {"context": {"dtype": "float32"}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_change(__name__="SkeletonState"), "'SkeletonState' .a single pose.*'SkeletonMotion'"),
        (_drop("__name__"), "__name__ is None, expected 'SkeletonMotion'"),
        (lambda data: [data], "__name__ is None, expected 'SkeletonMotion'"),
        (_drop("rotation"), "lacks the key 'rotation'; found __name__, fps"),
        (_drop("skeleton_tree"), "lacks the key 'skeleton_tree'"),
        (_drop("is_local"), "lacks the key 'is_local'"),
        (_change(skeleton_tree=[]), "lacks the key 'node_names'; found nothing"),
        (_change(rotation={"arr": np.zeros(3)}), "lacks the key 'context'"),
        (_change(rotation={"arr": ["a"], **_NUMBERS}), "rotation holds <U1"),
        (_change(rotation={"arr": [[1], [1, 2]], **_NUMBERS}), "no poselib clip .*inhomogeneous"),
        (_change(rotation={"arr": np.zeros((3, 2, 4)), **_NUMBERS}), r"shape \(3, 2, 4\)"),
        (_change(fps="fast"), "no poselib clip .*could not convert"),
        (_change(fps=[1, 2]), "no poselib clip .*size 1"),
        (_change(fps=0), "fps is 0, expected 0.1 to 10000"),
    ],
)
def test_bad_content_is_refused(
    tmp_path: Path, save_object_npy, data, change, message: str
) -> None:
    path = save_object_npy(tmp_path / "bad.npy", change(data))
    with pytest.raises(MotionFileError, match=message) as raised:
        load_poselib_npy(path)
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)
