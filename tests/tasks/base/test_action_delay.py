"""Actions that take effect later."""

from __future__ import annotations

import torch

from isaacgymenvs_lite.tasks.amp.deployable_observations import ActionDelay


def test_each_episode_has_a_delay_of_its_own():
    torch.manual_seed(0)
    delay = ActionDelay(1, 3, 300, 1, torch.device("cpu"))
    delay.reset(torch.arange(300))
    assert set(delay.steps.tolist()) == {1, 2, 3}
    for step in range(1, 8):
        taken = delay(torch.full((300, 1), float(step)))[:, 0]
        # before the first action: zero
        assert torch.equal(taken, (step - delay.steps).clamp(min=0).float())


def test_a_new_episode_forgets_the_actions_of_the_last_one():
    delay = ActionDelay(2, 2, 3, 1, torch.device("cpu"))
    for _ in range(4):
        delay(torch.ones(3, 1))
    delay.reset(torch.tensor([1]))
    assert delay(torch.full((3, 1), 5.0))[:, 0].tolist() == [1.0, 0.0, 1.0]
    assert delay(torch.full((3, 1), 6.0))[:, 0].tolist() == [1.0, 0.0, 1.0]
    assert delay(torch.full((3, 1), 7.0))[:, 0].tolist() == [5.0, 5.0, 5.0]
