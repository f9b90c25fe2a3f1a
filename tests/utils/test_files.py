from __future__ import annotations

import pytest

from isaacgymenvs_lite.utils.files import atomic_write, written_for_user


def test_what_was_written_takes_the_place(tmp_path):
    path = tmp_path / "policy.onnx"
    path.write_text("old")
    with atomic_write(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["policy.onnx"]
    assert path.read_text() == "new"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failure_leaves_the_old_file(tmp_path, error):
    path = tmp_path / "policy.onnx"
    path.write_text("old")
    with pytest.raises(error), atomic_write(path) as partial:
        partial.write_text("half")
        raise error
    assert [file.name for file in tmp_path.iterdir()] == ["policy.onnx"]
    assert path.read_text() == "old"


def test_a_link_in_a_shared_folder_is_not_followed(tmp_path):
    """Others can guess the name of the temporary file."""
    path, theirs = tmp_path / "page.html", tmp_path / "theirs"
    theirs.write_text("old")
    with atomic_write(path) as partial:
        name = partial.name
    (tmp_path / name).symlink_to(theirs)
    with atomic_write(path) as partial:
        partial.write_text("new")
    assert (theirs.read_text(), path.read_text()) == ("old", "new")
    assert not path.is_symlink()


def test_a_users_folder_is_made(tmp_path):
    path = tmp_path / "new" / "page.html"
    with written_for_user(path, "out") as partial:
        partial.write_text("page")
    assert path.read_text() == "page"
