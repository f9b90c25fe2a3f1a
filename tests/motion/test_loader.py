from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.npz import save_npz
from isaacgymenvs_lite.motion.loader import (
    DatasetEntry,
    fit_to_skeleton,
    load_clips,
    read_dataset,
    shipped_motions,
)
from isaacgymenvs_lite.motion.skeleton import Skeleton, skeleton_for_num_dofs


@pytest.fixture
def shipped(tmp_path: Path, make_humanoid_clip, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An assets folder with the clip march; the working directory is next to it."""
    for num_dofs in (28, 31):
        skeleton_for_num_dofs(num_dofs)  # cached before the models' folder moves away
    folder = tmp_path / "assets" / "amp" / "motions"
    folder.mkdir(parents=True)
    save_npz(folder / "march.npz", make_humanoid_clip())
    monkeypatch.setattr(paths, "assets_dir", lambda: tmp_path / "assets")
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    return folder


def test_clips_go_by_name_and_path(shipped: Path) -> None:
    (shipped / "README.md").touch()
    assert shipped_motions() == ["march"]
    for name in ("march", "march.npz", shipped / "march.npz"):
        ((clip, weight),) = load_clips(name)
        assert (clip.name, weight) == (str(shipped / "march.npz"), 1.0)
    assert load_clips("../assets/amp/motions/march.npz")[0][0].num_frames == 10


def test_own_file_goes_before_a_shipped_one(
    shipped: Path, make_humanoid_clip: Callable[..., MotionClip]
) -> None:
    save_npz(Path("march.npz"), make_humanoid_clip(num_frames=5))
    assert load_clips("march")[0][0].num_frames == 5


def test_missing_file_says_where_was_looked_and_what_is_shipped(shipped: Path) -> None:
    with pytest.raises(MotionFileError) as raised:
        load_clips("marsh.npy")
    message = str(raised.value)
    assert message.startswith("motion file 'marsh.npy' not found in ")
    for part in (str(Path.cwd()), str(shipped), "did you mean 'march'?", "shipped clips: march;"):
        assert part in message
    assert "\n" not in message
    with pytest.raises(MotionFileError, match=r"'/nowhere/a\.npy' not found; shipped clips"):
        load_clips("/nowhere/a.npy")


def test_unknown_suffix_lists_the_known(shipped: Path) -> None:
    Path("clip.fbx").write_bytes(b"")
    with pytest.raises(
        MotionFileError, match=r"ends in \.npz, \.npy, \.json, \.txt, \.csv, .*'\.fbx'"
    ):
        load_clips("clip.fbx")


def test_json_is_told_apart_by_content(shipped: Path) -> None:
    Path("clip.json").write_text(json.dumps({"Frames": []}))
    with pytest.raises(MotionFileError, match="no DeepMimic clip"):
        load_clips("clip.json")
    Path("clip.json").write_text(json.dumps({"rotation": []}))
    with pytest.raises(MotionFileError, match="expected 'SkeletonMotion'"):
        load_clips("clip.json")


def test_data_set_is_relative_to_its_own_folder(shipped: Path, make_humanoid_clip) -> None:
    folder = Path("sets")
    folder.mkdir()
    save_npz(folder / "a.npz", make_humanoid_clip(num_frames=5))
    (folder / "set.yaml").write_text(
        "motions: [{file: a.npz, weight: 2}, {file: march, weight: 0.5}]"
    )
    clips = load_clips("sets/set.yaml")
    assert [(clip.num_frames, weight) for clip, weight in clips] == [(5, 2.0), (10, 0.5)]


def test_data_set_errors_name_the_set_and_the_entry(shipped: Path) -> None:
    for entry, message in (
        ("bad.npz", "no .npz archive"),
        ("set.yaml", "a clip ends in"),
    ):
        Path("bad.npz").write_bytes(b"x")
        path = Path("set.yaml")
        path.write_text(f"motions: [{{file: march, weight: 1}}, {{file: {entry}, weight: 1}}]")
        with pytest.raises(MotionFileError, match=rf"^set.yaml: motions\[1\]: .*{message}"):
            load_clips(path)


def test_clip_of_another_humanoid_is_refused_with_its_place_in_the_set(
    shipped: Path, armed: Skeleton, make_humanoid_clip
) -> None:
    save_npz("armed.npz", make_humanoid_clip(skeleton=armed))
    Path("set.yaml").write_text("motions: [{file: march, weight: 1}, {file: armed.npz, weight: 1}]")
    for skeleton, message in (
        (None, r"motions\[1\]: armed\.npz: its skeleton also has sword, shield"),
        (armed, r"motions\[0\]: .*march\.npz: its skeleton lacks sword, shield"),
    ):
        with pytest.raises(MotionFileError, match=rf"^set\.yaml: {message}"):
            load_clips("set.yaml", skeleton)


def test_a_data_set_reads_each_file_once(tmp_path: Path) -> None:
    path = tmp_path / "set.yaml"
    path.write_text("motions:\n" + "- {file: walk, weight: 1}\n" * 3)
    clips = load_clips(path)
    assert len(clips) == 3
    assert clips[0][0] is clips[2][0]


LEFT_LEG_FIRST = [*range(9), 12, 13, 14, 9, 10, 11]


def _marked(clip: MotionClip) -> MotionClip:
    """Give every body its own velocity, which shows a wrong order."""
    velocity = np.zeros((clip.num_frames, clip.num_bodies, 3))
    velocity[..., 0] = np.arange(clip.num_bodies)
    return dataclasses.replace(clip, linear_velocity_w=velocity, angular_velocity_w=-velocity)


def test_bodies_are_brought_into_order(humanoid: Skeleton, make_humanoid_clip, about) -> None:
    ordered = _marked(make_humanoid_clip(num_frames=3))
    ordered.local_rotation[:, 12] = about("x", [0.1, 0.2, 0.3])  # left thigh
    order = LEFT_LEG_FIRST
    shuffled = dataclasses.replace(
        ordered,
        body_names=tuple(ordered.body_names[i] for i in order),
        parent_indices=(-1, 0, 1, 1, 3, 4, 1, 6, 7, 0, 9, 10, 0, 12, 13),
        local_translation=ordered.local_translation[order],
        local_rotation=ordered.local_rotation[:, order],
        linear_velocity_w=ordered.linear_velocity_w[:, order],
        angular_velocity_w=ordered.angular_velocity_w[:, order],
    )
    fitted = fit_to_skeleton(shuffled, humanoid)
    assert fitted.body_names == ordered.body_names
    assert fitted.parent_indices == ordered.parent_indices
    for name in (
        "local_translation",
        "local_rotation",
        "linear_velocity_w",
        "angular_velocity_w",
    ):
        np.testing.assert_array_equal(getattr(fitted, name), getattr(ordered, name), err_msg=name)


def test_other_bodies_are_named(humanoid: Skeleton, make_humanoid_clip) -> None:
    names = tuple("sword" if name == "head" else name for name in humanoid.body_names)
    clip = make_humanoid_clip(body_names=names)
    message = (
        "walk.npz: its skeleton lacks head and also has sword; expected the 15 bodies of the "
        "humanoid: pelvis, .*, left_foot; use a clip of this humanoid$"
    )
    with pytest.raises(MotionFileError, match=message):
        fit_to_skeleton(clip, humanoid)


def test_clip_of_the_other_humanoid_names_that_one(armed: Skeleton, make_humanoid_clip) -> None:
    what = r"walk\.npz: its skeleton lacks sword, shield;"
    with pytest.raises(MotionFileError, match=what) as raised:
        fit_to_skeleton(make_humanoid_clip(), armed)
    todo = "use task.env.asset.assetFileName=mjcf/amp_humanoid.xml or another clip"
    assert str(raised.value).endswith(todo)


def test_largest_hinge_violation_is_reported(
    humanoid: Skeleton, make_humanoid_clip, about, caplog
) -> None:
    clip = make_humanoid_clip(num_frames=4)
    clip.local_rotation[:, 10] = about("y", [0.0, 0.5, 1.0, 1.5])  # a right knee that bends
    with caplog.at_level(logging.WARNING):
        fit_to_skeleton(clip, humanoid)
    assert caplog.text == ""
    clip.local_rotation[:, 13] = about("x", [0.0, 0.1, 0.2, 0.1])  # a left knee that twists
    with caplog.at_level(logging.WARNING):
        fit_to_skeleton(clip, humanoid)
    (record,) = caplog.records
    message = record.getMessage()
    assert "'left_shin' is a hinge about (0, 1, 0) but rotates 0.200 rad" in message
    assert "in frame 2" in message


def test_other_dimensions_are_reported(humanoid: Skeleton, make_humanoid_clip, caplog) -> None:
    offsets = humanoid.local_translation.copy()
    offsets[0] += 5.0  # where the character stood in its file plays no part
    offsets[1] += 1e-4  # rounding in the file
    clip = make_humanoid_clip(local_translation=offsets)
    with caplog.at_level(logging.WARNING):
        fit_to_skeleton(clip, humanoid)
    assert caplog.text == ""
    offsets[10, 2] -= 0.05
    with caplog.at_level(logging.WARNING):
        fit_to_skeleton(make_humanoid_clip(local_translation=offsets), humanoid)
    assert "the offset of 'right_shin' differs by 0.050 m" in caplog.text


def test_speeds_and_places_that_are_doubtful_are_reported(
    humanoid: Skeleton, make_humanoid_clip, caplog
) -> None:
    clip = make_humanoid_clip()
    fast, far = clip.linear_velocity_w.copy(), clip.root_translation.copy()
    fast[1, 2, 0], far[:, 1] = 80.0, 2_000.0
    clip = dataclasses.replace(clip, linear_velocity_w=fast, root_translation=far)
    fit_to_skeleton(clip, humanoid)
    assert "a body moves at up to 80 m/s" in caplog.text
    assert "the root is up to 2000 m from the origin" in caplog.text


def test_entries_come_in_order(tmp_path: Path) -> None:
    path = tmp_path / "set.yaml"
    path.write_text(
        "motions:\n"
        "  - {file: b.npz, weight: 3}\n"
        "  - file: 'sub/a.npy'\n"
        "    weight: 0.5\n"
        "  - {file: c.npz, weight: 2e-5}\n"  # text for YAML 1.1, a number for everybody else
        "  - {file: d.npz, weight: 0}\n"
    )
    assert read_dataset(path) == [
        DatasetEntry("b.npz", 3.0),
        DatasetEntry("sub/a.npy", 0.5),
        DatasetEntry("c.npz", 2e-5),
        DatasetEntry("d.npz", 0.0),
    ]


def test_bad_data_sets_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "set.yaml"
    for text, message in (
        ("", "the key 'motions' is missing; expected a list"),
        ("motions: [a.npz]", r"motions\[0\]: got 'a.npz', expected a mapping"),
        ("motions: [{file: a, weigth: 1}]", r"unknown key 'motions\[0\].weigth' .*'weight'"),
        ("motions: [{file: a, weight: 1}, {file: b, weight: -1}]", r"motions\[1\].weight: got -1"),
        ("motions: [{file: a, weight: 0}, {file: b, weight: 0}]", "all 2 weights are 0"),
        ("a: !!python/object/apply:os.system ['true']", "is not valid YAML"),
    ):
        path.write_text(text)
        with pytest.raises(MotionFileError, match=message) as raised:
            read_dataset(path)
        assert str(raised.value).startswith(str(path))
        assert "\n" not in str(raised.value)
