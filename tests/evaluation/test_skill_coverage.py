"""Which clips generated motion reminds of."""

from __future__ import annotations

import torch

from isaacgymenvs_lite.evaluation.skill_coverage import ClipMatcher, ClipShares


def test_windows_go_to_the_nearest_clip() -> None:
    still, slow, fast = torch.tensor([[0.0, 0.0]]), torch.tensor([[1.0, 0.0], [2.0, 0.0]]), 5.0
    matcher = ClipMatcher([still, slow, torch.tensor([[fast, 0.0]])], ["still", "slow", "fast"])
    windows = torch.tensor([[0.4, 0.0], [0.6, 0.0], [2.9, 0.0], [3.6, 0.0]])
    assert matcher.nearest_clips(windows).tolist() == [0, 1, 1, 2]
    found = matcher.shares(windows)
    assert list(found.shares.items()) == [("slow", 0.5), ("still", 0.25), ("fast", 0.25)]


def test_a_feature_counts_by_its_spread_over_the_clips() -> None:
    # The first feature is a hundred times as wide: unscaled it alone would decide.
    clips = [torch.tensor([[0.0, 0.0]]), torch.tensor([[100.0, 1.0]])]
    matcher = ClipMatcher(clips, ["a", "b"])
    assert matcher.nearest_clips(torch.tensor([[60.0, 0.0], [40.0, 1.0]])).tolist() == [0, 1]


def test_a_clip_with_many_windows_does_not_set_the_scale() -> None:
    # Of the first feature 0, 0, ..., 4: a spread by clip of 2, by window of 0.4.
    clips = [torch.zeros(99, 2), torch.tensor([[4.0, 1.0]])]
    matcher = ClipMatcher(clips, ["long", "short"])
    assert matcher.nearest_clips(torch.tensor([[1.9, 0.0], [1.0, 0.9]])).tolist() == [0, 1]


def test_coverage_counts_clips_from_one_percent_on() -> None:
    shares = ClipShares({"a": 0.981, "b": 0.01, "c": 0.009, "d": 0.0})
    assert shares.coverage == 0.5
    assert str(shares).startswith("coverage 0.50 of 4 clips (a 98%, b 1%,")


def test_more_windows_than_fit_into_a_chunk() -> None:
    matcher = ClipMatcher([torch.zeros(1, 1), torch.ones(1, 1)], ["a", "b"])
    windows = (torch.arange(3000) % 3 == 0).float().unsqueeze(1)
    assert matcher.shares(windows).shares == {"a": 2 / 3, "b": 1 / 3}
