"""The small helpers of IsaacGymEnvs' `utils.utils`."""

from __future__ import annotations

import stat
import tempfile
from pathlib import Path

import pytest

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.isaacgymenvs_compat import utils


def test_nested_dictionaries_and_paths() -> None:
    nested = {"a": {"b": {"c": 1}}, "d": 2}
    assert utils.flatten_dict(nested) == {"a.b.c": 1, "d": 2}
    assert utils.flatten_dict(nested, prefix="x/", separator="/") == {"x/a/b/c": 1, "x/d": 2}
    assert utils.nested_dict_get_attr(nested, "a.b") == {"c": 1}
    utils.nested_dict_set_attr(nested, "a.b.c", 5)
    utils.nested_dict_set_attr(nested, "e", 6)
    assert nested == {"a": {"b": {"c": 5}}, "d": 2, "e": 6}


@pytest.mark.parametrize(("failures", "pauses"), [(0, []), (2, [1.0, 2.0])])
def test_a_failing_call_is_made_again(failures: int, pauses: list[float], monkeypatch) -> None:
    waited: list[float] = []
    monkeypatch.setattr(utils.time, "sleep", waited.append)
    calls: list[int] = []

    @utils.retry(3, exceptions=OSError)
    def double(number: int) -> int:
        calls.append(number)
        if len(calls) <= failures:
            raise ConnectionError("no network")
        return 2 * number

    assert double(number=4) == 8
    assert (len(calls), waited) == (failures + 1, pauses)


def test_the_last_failure_comes_through_and_others_at_once(monkeypatch) -> None:
    waited: list[float] = []
    monkeypatch.setattr(utils.time, "sleep", waited.append)

    @utils.retry(6, exceptions=(OSError,))
    def fail(error: Exception) -> None:
        raise error

    with pytest.raises(OSError, match="always"):
        fail(OSError("always"))
    assert waited == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0]
    with pytest.raises(KeyError):
        fail(KeyError("other"))
    assert len(waited) == 6


def test_folders(tmp_path: Path, monkeypatch) -> None:
    folder = str(tmp_path / "a" / "b")
    for make in (utils.ensure_dir_exists, utils.safe_ensure_dir_exists):
        assert make(folder) == folder
    assert Path(folder).is_dir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("LOGNAME", "someone")
    assert utils.get_username() == "someone"
    assert utils.project_tmp_dir() == str(tmp_path / "ige_someone")
    assert stat.S_IMODE((tmp_path / "ige_someone").stat().st_mode) == 0o700
    (tmp_path / "ige_someone").rmdir()
    (tmp_path / "ige_someone").symlink_to(folder)
    with pytest.raises(ConfigError, match="is a link"):
        utils.project_tmp_dir()
