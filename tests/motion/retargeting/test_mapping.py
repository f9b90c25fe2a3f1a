"""Tests mapping files: the shipped files, and messages about wrong files."""

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
    """Write the CMU mapping with other keys."""
    path = folder / f"{len(list(folder.iterdir()))}_mapping.yaml"
    path.write_text(yaml.safe_dump({**VALID, **changes}))
    return path


def bodies(**changes) -> dict:
    entries = {**VALID["bodies"], **changes}
    return {body: entry for body, entry in entries.items() if entry is not None}


def applied(turn: np.ndarray, vector: tuple[float, float, float]) -> np.ndarray:
    return rotations.quat_apply(torch.from_numpy(turn), torch.tensor(vector).double()).numpy()


def test_shipped_mappings_move_every_body(humanoid) -> None:
    for mapping in map(load_mapping, shipped_mappings()):
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


def test_every_axis_may_point_up(tmp_path: Path) -> None:
    for up in ("-x", "+y", "-z"):
        mapping = load_mapping(write(tmp_path, up=up))
        axis = [(1.0 if up[0] == "+" else -1.0) * (letter == up[1]) for letter in "xyz"]
        np.testing.assert_allclose(
            applied(mapping.to_z_up, tuple(axis)), [0.0, 0.0, 1.0], atol=1e-12
        )
        assert np.linalg.norm(mapping.to_z_up) == pytest.approx(1.0)


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "text.yaml").write_text("[")
    for mapping, message in (
        ("mixamo", "no such file; .*: cmu, lafan1"),
        (tmp_path / "text.yaml", r"text\.yaml is not valid YAML"),
        (write(tmp_path, up="up"), r"up.*'up'.*\+x"),
        (write(tmp_path, bodies=bodies(head=None)), "bodies lacks head"),
        (write(tmp_path, bodies=bodies(head={"joint": "Head"})), r"bodies\.head: expected x and z"),
        (write(tmp_path, bodies=["Hips"]), "mapping.yaml.*bodies"),
    ):
        with pytest.raises(ConfigError, match=message) as caught:
            load_mapping(mapping)
        assert "\n" not in str(caught.value)
