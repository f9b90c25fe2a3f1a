"""Mapping files: the shipped ones, and what is wrong with others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.retargeting.mapping import load_mapping, shipped_mappings
from isaacgymenvs_lite.utils import rotations

VALID = yaml.safe_load(shipped_mappings()["cmu"].read_text())


def write(folder: Path, **changes) -> Path:
    """Write the CMU mapping with other keys; None removes one."""
    content = {key: value for key, value in {**VALID, **changes}.items() if value is not None}
    path = folder / "mapping.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def bodies(**changes) -> dict:
    entries = {**VALID["bodies"], **changes}
    return {body: entry for body, entry in entries.items() if entry is not None}


def applied(turn: np.ndarray, vector: tuple[float, float, float]) -> np.ndarray:
    return rotations.quat_apply(torch.from_numpy(turn), torch.tensor(vector).double()).numpy()


@pytest.mark.parametrize("name", ["cmu", "lafan1"])
def test_shipped_mappings_move_every_body(name: str, humanoid) -> None:
    mapping = load_mapping(name)
    assert set(mapping.sources) == set(humanoid.body_names)
    np.testing.assert_allclose(applied(mapping.to_z_up, (0.0, 1.0, 0.0)), [0.0, 0.0, 1.0])
    # Forward in the files, +z, is our +x.
    np.testing.assert_allclose(applied(mapping.to_z_up, (0.0, 0.0, 1.0)), [1.0, 0.0, 0.0])


def test_axes_of_a_frame() -> None:
    frame = load_mapping("lafan1").sources["pelvis"].frame
    assert frame is not None
    # The joint's y is forward and its x up, so its z points to the left.
    np.testing.assert_allclose(applied(frame, (1.0, 0.0, 0.0)), [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(applied(frame, (0.0, 0.0, 1.0)), [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(applied(frame, (0.0, 1.0, 0.0)), [0.0, 0.0, 1.0], atol=1e-12)


@pytest.mark.parametrize("up", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_every_axis_may_point_up(tmp_path: Path, up: str) -> None:
    mapping = load_mapping(write(tmp_path, up=up))
    axis = [(1.0 if up[0] == "+" else -1.0) * (letter == up[1]) for letter in "xyz"]
    np.testing.assert_allclose(applied(mapping.to_z_up, tuple(axis)), [0.0, 0.0, 1.0], atol=1e-12)
    assert np.linalg.norm(mapping.to_z_up) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"up": "up"}, r"up.*'up'.*\+x"),
        ({"up": None}, "up' is missing"),
        ({"unit_m": 0}, "unit_m.*0"),
        ({"unit_m": "cm"}, "unit_m.*cm"),
        ({"bodies": bodies(tail="Tail")}, r"unknown body 'tail'.*choices: head, left_foot"),
        ({"bodies": bodies(head=None)}, "bodies lacks head"),
        ({"bodies": bodies(head={"joint": "Head"})}, r"bodies\.head: expected x and z"),
        ({"bodies": bodies(head={"joint": "Head", "x": "+z", "z": "-z"})}, "expected two axes"),
        ({"bodies": bodies(head={"joint": "Head", "x": "+z", "z": "up"})}, r"head\.z.*'up'"),
        ({"bodies": bodies(head={"joints": "Head"})}, r"unknown key '.*head\.joints'.*'joint'"),
        ({"bodies": bodies(head={"x": "+z", "z": "+y"})}, r"bodies\.head\.joint' is missing"),
        (
            {"bodies": bodies(head={**VALID["bodies"]["head"], "turn_deg": [1, 2, 3, 4]})},
            "expected three numbers",
        ),
        ({"bodies": ["Hips"]}, "bodies"),
    ],
)
def test_mistakes_are_one_line(tmp_path: Path, changes, message) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_mapping(write(tmp_path, **changes))
    assert "\n" not in str(caught.value)
    assert "mapping.yaml" in str(caught.value)


@pytest.mark.parametrize("text", ["[", "", "just text", "\x00"])
def test_no_mapping_at_all(tmp_path: Path, text: str) -> None:
    (tmp_path / "mapping.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"mapping\.yaml.*(YAML text|expected the keys up)"):
        load_mapping(tmp_path / "mapping.yaml")


def test_an_unknown_name_lists_the_shipped_ones() -> None:
    with pytest.raises(ConfigError, match=r"no such file; .*: cmu, lafan1"):
        load_mapping("mixamo")


def test_an_unknown_joint_lists_those_of_the_clip() -> None:
    with pytest.raises(ConfigError, match=r"bodies\.torso: a\.bvh has unknown joint 'Spine2'.*Hip"):
        load_mapping("lafan1").check_joints(["Hips", "Head", "Spine1"], "a.bvh")
