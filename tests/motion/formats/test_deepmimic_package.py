import importlib.util
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.formats.deepmimic import find_in_package
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.motion_lib import MotionLib
from tests.packages import needs

WALKS = ["humanoid3d_walk", "walker/0walk_forward"]
TURNS = [f"walker/turn_{side}" for side in ("left0", "left1", "right0", "right1")]
needs_the_package = needs("pybullet_data")


@pytest.fixture
def make_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Return a maker of a stand-in for pybullet_data that holds clips of two standing frames."""
    upright = [1.0, 0.0, 0.0, 0.0]
    leg, arm = [*upright, 0.0, *upright], [*upright, 0.0]
    frame = [0.1, 0.0, 1.0, 0.0, *upright, *upright, *upright, *leg, *arm, *leg, *arm]

    def make(*names: str) -> Path:
        motions = tmp_path / "pybullet_data" / "data" / "motions"
        (motions / "walker").mkdir(parents=True)
        (tmp_path / "pybullet_data" / "__init__.py").write_text("raise RuntimeError('imported')")
        for name in (*names, "laikago_walk"):
            (motions / f"{name}.txt").write_text(json.dumps({"Frames": [frame, frame]}))
        monkeypatch.syspath_prepend(tmp_path)
        return motions

    return make


def test_clips_are_found_without_importing_the_package(make_package) -> None:
    make_package("humanoid3d_walk", "walker/turn_left0")
    for name in ("humanoid3d_walk", "walk"):
        (clip, weight), *others = load_clips(f"deepmimic:{name}")
        assert (clip.name, weight, others) == ("deepmimic:humanoid3d_walk", 1.0, [])
    choices = "data sets: all, locomotion; clips: humanoid3d_walk, walker/turn_left0$"
    message = f"data set 'wlk' \\(did you mean 'walk'\\?\\); {choices}"
    with pytest.raises(MotionFileError, match=message):
        load_clips("deepmimic:wlk")


def test_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MotionFileError, match=r'pip install "isaacgymenvs-lite\[motions\]"'):
        load_clips("deepmimic:walk")


def test_kinds_of_locomotion_weigh_the_same(make_package) -> None:
    make_package(*WALKS, *TURNS, "humanoid3d_run", "humanoid3d_jump")
    weights = {clip.name: clip.weight for clip in find_in_package("deepmimic:locomotion")}
    # A third for walking (two clips), turning (four clips) and running (one clip) each.
    expected = dict.fromkeys(WALKS, 1 / 6) | dict.fromkeys(TURNS, 1 / 12)
    expected["humanoid3d_run"] = 1 / 3
    assert weights == pytest.approx({f"deepmimic:{name}": w for name, w in expected.items()})


def test_all_takes_every_humanoid_and_new_clips_as_kinds_of_their_own(make_package) -> None:
    make_package("humanoid3d_dance_a", "humanoid3d_dance_b", "humanoid3d_run", "humanoid3d_swim")
    weights = {clip.name: clip.weight for clip in find_in_package("deepmimic:all")}
    expected = {"dance_a": 1 / 6, "dance_b": 1 / 6, "run": 1 / 3, "swim": 1 / 3}
    assert weights == pytest.approx(
        {f"deepmimic:humanoid3d_{name}": w for name, w in expected.items()}
    )


def test_set_of_the_package_shares_the_weight_of_its_entry(make_package, tmp_path: Path) -> None:
    make_package("humanoid3d_run", "humanoid3d_jump")
    path = tmp_path / "set.yaml"
    path.write_text(
        'motions: [{file: "deepmimic:all", weight: 4}, {file: "deepmimic:run", weight: 1}]'
    )
    found = [(clip.name.rpartition("_")[2], weight) for clip, weight in load_clips(path)]
    assert found == [("jump", 2.0), ("run", 2.0), ("run", 1.0)]


@needs_the_package
@pytest.mark.parametrize(
    ("name", "num_clips", "num_kinds", "num_dofs", "num_keys"),
    [("locomotion", 7, 3, 31, 6), ("all", 20, 9, 28, 4)],
)
def test_real_data_sets_give_finite_states(
    name: str, num_clips: int, num_kinds: int, num_dofs: int, num_keys: int
) -> None:
    lib = MotionLib(f"deepmimic:{name}", num_dofs, range(num_keys), "cpu")
    assert lib.num_motions() == num_clips
    run = [lib.get_motion(i).name for i in range(num_clips)].index("deepmimic:humanoid3d_run")
    torch.manual_seed(0)
    ids = lib.sample_motions(9000)
    # Running is the only clip of its kind: it has the whole share of the kind, within 5 sigma.
    share = (ids == run).float().mean().item()
    assert share == pytest.approx(1 / num_kinds, abs=5 * np.sqrt(1 / (num_kinds * 9000)))
    state = lib.get_motion_state(ids, lib.sample_time(ids))
    for key, values in state._asdict().items():
        assert torch.isfinite(values).all(), key
    assert state.dof_pos.shape == (9000, num_dofs)
    assert state.key_pos.shape == (9000, num_keys, 3)
    # Nobody is under the ground or flies; the fastest joints turn by some 20 rad/s.
    assert 0.1 < state.root_pos[:, 2].min() < state.root_pos[:, 2].max() < 1.3
    assert state.dof_vel.abs().max() < 50.0


@needs_the_package
def test_the_locomotion_clips_go_where_their_names_say() -> None:
    for clip, _ in load_clips("deepmimic:locomotion"):
        # Heading of the pelvis' x axis, first and last frame, rad.
        x, y, z, w = clip.local_rotation[[0, -1], 0].T
        first, last = np.arctan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z))
        turn_deg = np.rad2deg((last - first + np.pi) % (2 * np.pi) - np.pi)
        side = 1.0 if "left" in clip.name else -1.0
        if "turn" in clip.name:
            assert side * turn_deg > 20.0, clip.name
        else:
            assert abs(turn_deg) < 10.0, clip.name
        assert clip.root_translation[-1, 0] - clip.root_translation[0, 0] > 0.7, clip.name
