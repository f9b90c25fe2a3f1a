"""Clips that cannot be written say so, and none is replaced unasked."""

from __future__ import annotations

from pathlib import Path

import pytest

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.formats.files import check_output, written_clip


def test_a_folder_that_cannot_be_written_to(tmp_path: Path) -> None:
    path = tmp_path / "none" / "clip.npz"
    with (
        pytest.raises(MotionFileError, match=r"cannot write .*none/clip\.npz \(No such file"),
        written_clip(path) as partial,
    ):
        partial.write_text("")


def test_outputs_are_checked_before_the_work(tmp_path: Path) -> None:
    suffixes = (".npz", ".csv")
    path = tmp_path / "clip.npz"
    check_output(path, suffixes, overwrite=False)
    path.write_text("")
    with pytest.raises(MotionFileError, match="exists already; overwrite=True replaces it"):
        check_output(path, suffixes, overwrite=False)
    check_output(path, suffixes, overwrite=True)
    with pytest.raises(MotionFileError, match=r"found '\.fbx'; choices: \.npz, \.csv"):
        check_output(tmp_path / "clip.fbx", suffixes, overwrite=True)
    with pytest.raises(MotionFileError, match=r"the folder .*none does not exist"):
        check_output(tmp_path / "none" / "clip.npz", suffixes, overwrite=True)
