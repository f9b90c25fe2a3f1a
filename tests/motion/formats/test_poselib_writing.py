"""Clips written as poselib does: only published names in the pickle, the same clip when read."""

from __future__ import annotations

import pickletools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from isaacgymenvs_lite.motion.formats.poselib import load_poselib_npy, save_poselib_npy
from isaacgymenvs_lite.motion.loader import load_clips

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
