"""Who is replaced by whom, by hand."""

from __future__ import annotations

import random
import re
from dataclasses import replace
from pathlib import Path

from isaacgymenvs_lite.config.pbt_settings import PBTSettings
from isaacgymenvs_lite.pbt.observer import find_replacement, num_needed

EIGHT = PBTSettings(enabled=True, num_policies=8, policy_idx=7)
# The best three are 0, 1, 2; the last is the worst.
OBJECTIVES = {index: 100.0 - 10.0 * index for index in range(8)}


class First(random.Random):
    def choice(self, seq):
        return seq[0]


def found(settings=EIGHT, objectives=OBJECTIVES, best=30.0):
    return find_replacement(settings, objectives, best, First())


def test_the_worst_goes_on_with_the_weights_of_one_of_the_best():
    assert found() == 0
    donors = {find_replacement(EIGHT, OBJECTIVES, 30.0, random.Random(n)) for n in range(50)}
    assert donors == {0, 1, 2}  # ceil(0.3 * 8)


def test_no_other_one_is_replaced():
    for index in range(7):
        assert found(replace(EIGHT, policy_idx=index)) is None  # ceil(0.125 * 8) = 1


def test_a_difference_below_a_threshold_changes_settings_only():
    for changed, expected in [
        # 0 leads by 70. Without the one outlier, 30, the spread of 40, 50, ..., 100 is 20.
        ({"replace_threshold_frac_std": 3.49}, 0),
        ({"replace_threshold_frac_std": 3.5}, 7),
        # 70 is 0.7 of 100.
        ({"replace_threshold_frac_absolute": 0.69}, 0),
        ({"replace_threshold_frac_absolute": 0.7}, 7),
    ]:
        assert found(replace(EIGHT, **changed)) == expected


def test_one_that_broke_down_does_not_hide_the_differences():
    broken = {**OBJECTIVES, 6: 20.0, 7: -1e6}
    assert found(objectives=broken, best=-1e6) == 0


def test_an_unknown_policy_ranks_last():
    known = {index: OBJECTIVES[index] for index in range(7)}
    assert found(replace(EIGHT, policy_idx=6), known) is None
    both = replace(EIGHT, policy_idx=6, replace_fraction_worst=0.25)
    assert found(both, known) == 0


def test_more_than_half_must_be_known():
    for total, needed in [(1, 1), (2, 2), (3, 3), (4, 3), (8, 5), (9, 5)]:
        assert num_needed(total) == needed


def test_the_page_has_the_keys_and_their_defaults():
    page = (Path(__file__).parents[2] / "docs" / "pbt.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(?:pbt\.)?(\w+)` \| `?([^|`]+?)`? \|", page, re.M))
    defaults = {name: getattr(EIGHT, name) for name in PBTSettings.__dataclass_fields__}
    del defaults["mutation"], defaults["enabled"]
    defaults |= {"policy_idx": 0, "num_policies": 8}
    assert {name: rows[name].replace(",", "") for name in defaults} == {
        name: str(value) for name, value in defaults.items()
    }
