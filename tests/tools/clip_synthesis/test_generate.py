"""The generator makes the shipped files, and says what is wrong when it cannot."""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.errors import ConfigError, MissingPackageError
from isaacgymenvs_lite.motion.formats.npz import load_npz
from isaacgymenvs_lite.motion.loader import load_clips
from tools.clip_synthesis import __main__ as command
from tools.clip_synthesis import solve
from tools.clip_synthesis.catalogue import GAIT_CLIPS, make_clip
from tools.clip_synthesis.gait_data import GAITS
from tools.clip_synthesis.generate import generate


@pytest.mark.parametrize("name", [*GAIT_CLIPS, "jump", "walk_right"])
def test_shipped_clips_are_what_the_generator_makes(name: str) -> None:
    pytest.importorskip("mink")
    made, shipped = make_clip(name), load_clips(name)[0][0]
    assert made.fps == shipped.fps
    assert made.body_names == shipped.body_names
    # The search stops at steps of 1e-8 rad; other versions of the solver end elsewhere in there.
    np.testing.assert_allclose(made.local_rotation, shipped.local_rotation, atol=1e-4)
    np.testing.assert_allclose(made.root_translation, shipped.root_translation, atol=1e-4)
    np.testing.assert_allclose(made.linear_velocity_w, shipped.linear_velocity_w, atol=1e-2)
    np.testing.assert_allclose(made.angular_velocity_w, shipped.angular_velocity_w, atol=1e-2)


def test_command_writes_the_chosen_clip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "make_clip", lambda name: load_clips(name)[0][0])
    assert command.main(["--out", str(tmp_path / "clips"), "--clips", "walk"]) == 0
    assert [path.name for path in (tmp_path / "clips").iterdir()] == ["walk.npz"]
    assert load_npz(tmp_path / "clips" / "walk.npz").name.endswith("walk.npz")


def test_unknown_clip_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"unknown clip 'jumq' \(did you mean 'jump'\?\)"):
        make_clip("jumq")


def test_missing_mink_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match=r"isaacgymenvs-lite\[retarget\]"):
        solve.PoseSolver(mujoco.MjModel.from_xml_string("<mujoco/>"), ())


def test_cycles_of_an_odd_number_of_frames_are_refused() -> None:
    odd = dataclasses.replace(GAITS["walk"], period_s=55 / 60)
    with pytest.raises(ValueError, match="55 frames at 60 fps, expected an even number"):
        generate(odd, 1)


@pytest.mark.parametrize("name", sorted(GAITS))
def test_tables_are_complete_and_sourced(name: str) -> None:
    gait = GAITS[name]
    assert len(gait.sources) >= 3
    for table in (gait.hip_flexion, gait.knee_flexion, gait.ankle_dorsiflexion):
        assert len(table) == 20
    for table in (gait.shoulder_flexion, gait.elbow_flexion):
        assert len(table) == 20
    for table in (gait.pelvis_tilt, gait.pelvis_obliquity, gait.pelvis_rotation):
        assert len(table) == 10
    assert len(gait.thorax_rotation) == 10
