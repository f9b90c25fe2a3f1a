"""The paces of characters that hold the latents of clips, and which clips they follow."""

from __future__ import annotations

import math

import pytest
import torch

import isaacgymenvs_lite
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.evaluation.skill_pace import ClipPaces, Pace, PaceProbe


@pytest.fixture
def make():
    """Return a maker of HumanoidASE with clips."""
    made = []

    def make(num_envs: int, *overrides: str):
        cfg = compose(["task=HumanoidASE", f"num_envs={num_envs}", *overrides])
        made.append(isaacgymenvs_lite.make(num_envs=num_envs, cfg=cfg))
        return made[-1]

    yield make
    for task in made:
        task.close()


def test_a_clip_is_followed_at_half_of_its_pace() -> None:
    clips = {
        "walk": Pace(1.3, 0.0, 0.0),
        "back": Pace(-0.9, 0.0, 0.0),
        "turn": Pace(0.0, 0.0, math.radians(60.0)),  # counts as 0.6 m/s
        "stand": Pace(0.01, 0.0, 0.0),
    }
    shown = {
        "walk": Pace(0.7, 0.1, 0.0),
        "back": Pace(0.0, 0.0, 0.0),
        "turn": Pace(0.0, 0.0, math.radians(95.0)),  # 0.35 m/s off, more than 0.3
        "stand": Pace(0.0, 0.0, 0.0),
    }
    found = ClipPaces(clips, shown)
    assert found.moving == ["walk", "back", "turn"]
    assert found.followed == ["walk"]
    first, *rows = str(found).splitlines()
    assert first == "follows 1 of the 3 clips that travel or turn"
    assert rows[2] == "  turn: 0.00, 0.00 m/s, 60 deg/s; shown 0.00, 0.00 m/s, 95 deg/s"


def test_the_probe_averages_the_motion_after_two_seconds(make) -> None:
    task = make(2, "task.env.motion_file=walk_backward")
    task.reset_done()
    probe = PaceProbe(task, ["walk_backward"], torch.tensor([0, 0]))
    rows, still = torch.arange(2), torch.zeros(2, task.num_actions)
    for step, forward_m_s in [(10, 9.0), (61, 1.0), (62, 2.0)]:
        root = torch.zeros(2, 13)
        root[:, 2], root[:, 6], root[:, 7] = 0.9, 1.0, torch.tensor([forward_m_s, 0.5])
        task.simulation.write_state(rows, root, still, still)
        task.progress_buf[:] = step
        probe.step()
    found = probe.result()
    assert found is not None
    assert found.shown["walk_backward"] == pytest.approx((1.0, 0.0, 0.0))  # (1 + 2 + 0.5 + 0.5) / 4
    assert found.clips["walk_backward"].forward_m_s == pytest.approx(-0.94, abs=0.02)


def test_no_pace_of_short_episodes(make) -> None:
    task = make(1)
    task.reset_done()
    probe = PaceProbe(task, ["a"], torch.tensor([0]))
    probe.step()
    assert probe.result() is None
