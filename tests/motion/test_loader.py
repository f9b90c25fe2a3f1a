import json
from collections.abc import Callable
from pathlib import Path

import pytest

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.npz import save_npz
from isaacgymenvs_lite.motion.loader import load_clips, shipped_motions
from isaacgymenvs_lite.motion.skeleton import Skeleton, skeleton_for_num_dofs


@pytest.fixture
def shipped(tmp_path: Path, make_humanoid_clip, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An assets folder that ships the clip march; the working directory is beside it."""
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
