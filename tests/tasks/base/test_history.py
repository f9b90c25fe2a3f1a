"""Histories, the newest first."""

from __future__ import annotations

import torch

from isaacgymenvs_lite.tasks.amp.deployable_observations import push_newest


def test_the_newest_frame_comes_first():
    history = torch.zeros(1, 3, 2)
    for number in range(1, 5):
        push_newest(history, torch.full((1, 2), float(number)))
    assert history.tolist() == [[[4.0, 4.0], [3.0, 3.0], [2.0, 2.0]]]
