"""What a played skill policy tells of its skills."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from isaacgymenvs_lite.learning.gen_amp_players import SkillProbe

HISTORY, STRIDE = 3, 10


class Library:
    def num_motions(self) -> int:
        return 2

    def get_motion(self, i: int) -> SimpleNamespace:
        return SimpleNamespace(name=f"/clips/{'ab'[i]}.npz")


class Encoder:
    """Pays the latent's first number where it is that of the window."""

    def reward(self, amp_obs: torch.Tensor, latents: torch.Tensor) -> torch.Tensor:
        return (amp_obs[:, :1] == latents[:, :1]).float()


@pytest.fixture
def env() -> SimpleNamespace:
    return SimpleNamespace(
        num_amp_obs_steps=HISTORY,
        motion_lib=Library(),
        progress_buf=torch.tensor([HISTORY, HISTORY - 1, 50]),
        windows_of_clips=lambda: [torch.tensor([[0.0, 0.0]]), torch.tensor([[9.0, 0.0]])],
    )


def test_windows_of_the_policy_s_own_making_count(env) -> None:
    probe = SkillProbe(env, Encoder())  # pyright: ignore[reportArgumentType]
    rows = torch.tensor([[1.0, 0.0], [9.0, 0.0], [8.0, 0.0]])
    for _ in range(2 * STRIDE):
        probe.step(rows, rows)
    result = probe.result()
    assert result is not None
    # Environment 1 has not made a whole window yet.
    assert result.clips.shares == {"a": 0.5, "b": 0.5}
    assert result.encoder_reward == 1.0
    # Of four rows with two latents a shuffle leaves some in place, and not always all.
    assert 0.0 <= result.shuffled_reward <= 1.0
    assert "coverage 1.00 of 2 clips" in str(result)


def test_latents_are_shuffled(env) -> None:
    torch.manual_seed(0)
    env.progress_buf = torch.full((64,), 50)
    rows = torch.arange(64.0).unsqueeze(1).expand(-1, 2)
    probe = SkillProbe(env, Encoder())  # pyright: ignore[reportArgumentType]
    for _ in range(STRIDE):
        probe.step(rows, rows)
    result = probe.result()
    assert result is not None
    # A permutation leaves one row of any number in place on average.
    assert result.shuffled_reward <= 5 / 64


def test_episodes_that_are_too_short_say_nothing(env) -> None:
    env.progress_buf[:] = 1
    probe = SkillProbe(env, Encoder())  # pyright: ignore[reportArgumentType]
    for _ in range(STRIDE):
        probe.step(torch.zeros(3, 2), torch.zeros(3, 2))
    assert probe.result() is None
