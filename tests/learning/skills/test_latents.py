from __future__ import annotations

import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.skills.latents import (
    EvaluationLatents,
    LatentSchedule,
    interpolate_on_sphere,
    sample_latents,
)

N, DIM = 400, 8


@pytest.fixture
def schedule() -> LatentSchedule:
    torch.manual_seed(0)
    return LatentSchedule(N, DIM, 2, 5)


def test_latents_are_unit_vectors_all_over_the_sphere():
    torch.manual_seed(0)
    latents = sample_latents(10_000, 3)
    torch.testing.assert_close(latents.norm(dim=-1), torch.ones(10_000))
    # uniform on the sphere: mean 0, each component's variance 1/3 (standard error 0.006, 0.003)
    assert latents.mean(0).abs().max() < 0.03
    assert (latents.var(0) - 1 / 3).abs().max() < 0.015


def test_a_latent_is_kept_for_min_to_below_max_steps(schedule):
    env_ids = torch.arange(N)
    schedule.restart(env_ids)
    kept: list[list[int]] = [[] for _ in range(N)]
    last, since = schedule.latents.clone(), torch.zeros(N, dtype=torch.long)
    for step in range(60):
        progress = torch.full((N,), step)
        over = schedule.is_over(progress)
        schedule.advance(progress)
        changed = (schedule.latents != last).any(dim=-1)
        assert torch.equal(changed, over)
        for env in changed.nonzero().flatten().tolist():
            kept[env].append(step - int(since[env]))
            since[env] = step
        last = schedule.latents.clone()
    lengths = torch.tensor([length for lengths in kept for length in lengths])
    # steps_max itself is never drawn
    assert lengths.unique().tolist() == [2, 3, 4]
    counts = torch.bincount(lengths)[2:].double()
    assert (counts / counts.sum() - 1 / 3).abs().max() < 0.03


def test_a_new_episode_gets_a_new_latent_and_a_new_clock(schedule):
    schedule.advance(torch.full((N,), 10_000))
    before = schedule.latents.clone()
    env_ids = torch.tensor([3, 7])
    schedule.restart(env_ids)
    changed = (schedule.latents != before).any(dim=-1).nonzero().flatten()
    assert changed.tolist() == [3, 7]
    # counted from the start of the episode, not from where the old one was
    progress = torch.zeros(N, dtype=torch.long)
    assert not schedule.is_over(progress + 1)[env_ids].any()
    assert schedule.is_over(progress + 4)[env_ids].all()
    schedule.restart(env_ids[:0])


def test_the_latents_of_earlier_steps_are_not_written_into(schedule):
    earlier = schedule.latents
    copy = earlier.clone()
    schedule.advance(torch.full((N,), 100))
    assert torch.equal(earlier, copy)
    assert not torch.equal(schedule.latents, copy)


@pytest.mark.parametrize(("least", "most"), [(0, 5), (5, 5), (6, 5), (-1, 5)])
def test_impossible_steps_are_refused(least, most):
    with pytest.raises(ConfigError, match="expected 1 <= min < max"):
        LatentSchedule(4, DIM, least, most)


# --- played -----------------------------------------------------------------------------------


@pytest.mark.parametrize("interpolate", [False, True])
def test_episodes_start_at_a_latent_of_their_own(interpolate):
    torch.manual_seed(0)
    played = EvaluationLatents(LatentSchedule(4, DIM, 3, 6), interpolate)
    progress = torch.zeros(4, dtype=torch.long)
    first = played(progress)
    torch.testing.assert_close(first.norm(dim=-1), torch.ones(4))
    for step in range(1, 5):
        last = played(progress + step)
    # environment 2 starts again, the others go on
    again = played(torch.tensor([5, 5, 0, 5]))
    assert (again[2] - last[2]).norm() > 0.1
    assert (again[2] - first[2]).norm() > 0.1


def test_played_latents_jump_or_move():
    torch.manual_seed(0)
    steps = 40
    jumping, moving = (
        EvaluationLatents(LatentSchedule(N, DIM, 10, 11), way) for way in (False, True)
    )
    jumps, moves = (
        torch.stack([played(torch.full((N,), i)) for i in range(steps)])
        for played in (jumping, moving)
    )
    torch.testing.assert_close(moves.norm(dim=-1), torch.ones(steps, N))
    jumped = (jumps[1:] != jumps[:-1]).any(dim=-1)
    assert jumped.nonzero()[:, 0].unique().tolist() == [9, 19, 29]
    # the same angle at every step of a way, and no two steps alike; ways are of 10 steps
    angles = (moves[1:] * moves[:-1]).sum(-1).clamp(-1, 1).acos()
    way = angles[10:20]
    torch.testing.assert_close(way, way[:1].expand_as(way), rtol=1e-2, atol=1e-3)
    assert angles[10:].min() > 0.01
    # random directions are about a quarter of a turn apart
    assert abs(10 * angles[10:].mean().item() - 1.57) < 0.1


def test_interpolation_on_the_sphere():
    start, end = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]])
    for share, expected in ((0.0, start), (1.0, end)):
        found = interpolate_on_sphere(start, end, torch.tensor([share]))
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    third = interpolate_on_sphere(start, end, torch.tensor([1 / 3]))
    assert third[0].tolist() == pytest.approx([3**0.5 / 2, 0.5, 0.0])
    assert torch.equal(interpolate_on_sphere(start, start, torch.tensor([0.5])), start)
