from pathlib import Path

import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.loader import DatasetEntry, read_dataset


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
