"""The small helpers of IsaacGymEnvs' `utils.utils`."""

from __future__ import annotations

import pytest

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
