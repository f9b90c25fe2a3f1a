"""Tests the convert command: all pairs of formats, and one line for each mistake."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from isaacgymenvs_lite.motion import convert as command
from isaacgymenvs_lite.motion.formats.npz import load_npz, save_npz
from isaacgymenvs_lite.motion.loader import load_clips, load_single_clip

SUFFIXES = (".npz", ".npy", ".txt", ".json", ".csv")


pytestmark = pytest.mark.usefixtures("in_an_empty_folder")


def convert(*words: str) -> None:
    assert command.main(list(words)) == 0


@pytest.mark.parametrize(("first", "second"), list(itertools.pairwise((*SUFFIXES, ".npz"))))
def test_every_format_into_every_other(first: str, second: str) -> None:
    convert("walk_slow", f"a{first}")
    convert(f"a{first}", f"b{second}")
    convert(f"b{second}", "c.npz")
    clip, again = load_clips("walk_slow")[0][0], load_npz("c.npz")
    assert again.num_frames == clip.num_frames
    assert again.fps == pytest.approx(clip.fps, rel=1e-6)
    # float32 (6e-8 of 3 m), three times.
    np.testing.assert_allclose(again.global_poses()[0], clip.global_poses()[0], atol=5e-6)


@pytest.mark.parametrize("suffix", [".npy", ".csv"])
def test_the_armed_humanoid(suffix: str, make_humanoid_clip, armed, about) -> None:
    clip = make_humanoid_clip(num_frames=4, skeleton=armed)
    clip.local_rotation[:, armed.body_names.index("right_hand")] = about("x", [0.3] * 4)
    save_npz("in.npz", clip)
    convert("in.npz", f"out{suffix}")
    again, skeleton = load_single_clip(f"out{suffix}")
    assert skeleton is armed
    np.testing.assert_allclose(again.local_rotation, clip.local_rotation, atol=1e-7)


def test_deepmimic_is_of_the_humanoid_that_is_asked_for() -> None:
    convert("walk_slow", "a.txt")
    convert("a.txt", "b.npz")
    convert("a.txt", "c.npz", "num_dofs=31")
    assert (load_npz("b.npz").num_bodies, load_npz("c.npz").num_bodies) == (15, 17)


def test_cut_and_rate() -> None:
    convert("walk_slow", "a.npz", "start_s=0.5", "end_s=1.5", "fps=60")
    part = load_npz("a.npz")
    assert (part.fps, part.num_frames) == (60.0, 61)


def test_what_is_lost_is_said(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"):
        convert("walk_slow", "a.csv")
    assert "a.csv: 109 frames at 30 Hz, 3.60 s, 28 degrees of freedom; lost: velocit" in caplog.text


def test_outputs_are_replaced_only_when_asked(refused) -> None:
    convert("walk_slow", "a.npz")
    content = Path("a.npz").read_bytes()
    assert "exists already; overwrite=True" in refused("walk", "a.npz")
    assert Path("a.npz").read_bytes() == content
    convert("walk", "a.npz", "overwrite=True")
    assert load_npz("a.npz").num_frames == 217


def test_mistakes_are_one_line(refused) -> None:
    for words, message in (
        (("walk", "a.fbx"), "found '.fbx'; choices: .npz, .npy, .txt, .json, .csv"),
        (("nowhere.npz", "a.npz"), "'nowhere.npz' not found"),
        (("locomotion", "a.npz"), "is a data set; give one of its clips"),
        (("walk", "a.npz", "end_s=9"), "is no part of the clip"),
        (("walk", "a.npz", "mapping=cmu"), "needs a .bvh file or robot=; leave it out"),
        (("walk", "a.npz", "fsp=30"), "unknown key 'fsp' (did you mean 'fps'?)"),
        (("clip.bvh", "a.npz"), "clip.bvh: no such file"),
        (("walk", "a.npz", "by_order=True"), "by_order= need robot=, the file of a robot"),
    ):
        assert message in refused(*words)


def test_a_full_disk_leaves_nothing(refused, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    assert "a.npz (No space left on device)" in refused("walk", "a.npz")
