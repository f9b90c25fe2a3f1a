"""Where in its clip an episode is, and how far from it: on a clip of three points made by hand."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.amp.clip_phases import (
    COMPARED_S,
    PHASES_PER_STEP,
    ClipPhases,
    distance_up_to_heading_m,
    travel_through,
)

DT_S = 0.04
STEPS = 25
LENGTH_S = DT_S * STEPS


def body(time_s: Tensor, turn_rad: float = 0.0) -> Tensor:
    """Three points (n, 3, 3): one is fixed, one goes round it, the root rises and sinks."""
    angle = 2.0 * math.pi * time_s / LENGTH_S
    zeros, ones = torch.zeros_like(angle), torch.ones_like(angle)
    root = torch.stack((zeros, zeros, 1.0 + 0.3 * angle.sin()), dim=-1)
    fixed = turned(0.8 * ones, zeros, turn_rad)
    return torch.stack((root, fixed, turned(angle.cos(), angle.sin(), turn_rad)), dim=-2)


def turned(x: Tensor, y: Tensor, angle_rad: float) -> Tensor:
    """Points (n, 3) on the ground, turned about z."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return torch.stack((cos * x - sin * y, sin * x + cos * y, torch.zeros_like(x)), dim=-1)


def clip(length_s: float = LENGTH_S) -> Tensor:
    return body(torch.arange(0.0, length_s - 1e-6, DT_S / PHASES_PER_STEP))


def followed(clip_points: Tensor, episode: Tensor, start_s: float = 0.0) -> Tensor:
    """Distances (T,) m over an episode (T, P, 3) that starts at a time of the clip."""
    phases = ClipPhases([clip_points], 1, DT_S, limit_m=0.3)
    phases.start(torch.tensor([0]), torch.tensor([0]), torch.tensor([start_s]))
    return torch.cat([phases.advance(points.unsqueeze(0)) for points in episode])


def times(steps: int, tempo: float = 1.0, start_s: float = 0.0) -> Tensor:
    return start_s + tempo * DT_S * torch.arange(1, steps + 1)


def test_the_distance_is_that_of_the_best_turn() -> None:
    torch.manual_seed(1)
    points, others = torch.randn(2, 5, 4, 3)
    angles = torch.linspace(-math.pi, math.pi, 20_001)
    for one, other in zip(points, others, strict=True):
        cos, sin = angles.cos()[:, None], angles.sin()[:, None]
        x, y, z = one.unbind(-1)
        turned = torch.stack((cos * x - sin * y, sin * x + cos * y, z.expand(20_001, 4)), dim=-1)
        best = (turned - other).square().sum(dim=(-1, -2)).argmin()
        expected = (turned[best] - other).norm(dim=-1).mean()
        # The angles are 3e-4 rad apart, the points about 2 m from the axis.
        torch.testing.assert_close(
            distance_up_to_heading_m(one, other), expected, atol=1e-3, rtol=0
        )


def test_an_episode_at_its_own_tempo_is_near() -> None:
    for tempo in [0.5, 0.8, 1.0, 1.3, 2.0]:
        for start_s in [0.0, 0.6]:
            episode = body(times(3 * STEPS, tempo, start_s), turn_rad=2.0)
            away_m = followed(clip(), episode, start_s)
            # Half a phase is 0.02 m of the three points, and a tempo that is off is 0.02 m.
            assert away_m.max() < 0.06


def test_one_that_stays_behind_is_far() -> None:
    for tempo in [0.0, 0.25, -1.0]:
        away_m = followed(clip(), body(times(2 * STEPS, tempo)))
        assert away_m[0] < 0.2
        assert away_m.max() > 0.6


def test_at_rest_it_goes_on_at_the_tempo_of_the_clip() -> None:
    """A clip that rests, then moves: noise does not move the phase of a body at rest."""
    torch.manual_seed(1)
    rest = body(torch.zeros(PHASES_PER_STEP * STEPS))
    moves = torch.cat((rest, clip()))
    noise = 0.002 * torch.randn(STEPS - 1, 3, 3)
    away_m = followed(moves, torch.cat((rest[: STEPS - 1] + noise, body(times(STEPS)))))
    assert away_m.max() < 0.06


def test_a_clip_that_does_not_close_ends() -> None:
    """Half the circle: afterwards anything is allowed."""
    half = clip(LENGTH_S / 2)
    steps = STEPS // 2
    standing = body(torch.zeros(2 * STEPS))
    away_m = followed(half, torch.cat((body(times(steps)), standing)))
    assert away_m[:steps].max() < 0.05
    assert away_m[steps + 2 :].eq(0.0).all()
    # Standing from the first step on is far until its slowest phase is at the end.
    away_m = followed(half, standing)
    assert away_m[steps:].max() > 0.4
    assert away_m[-1] == 0.0


def test_environments_are_followed_one_by_one() -> None:
    phases = ClipPhases([clip()], 3, DT_S, limit_m=0.3)
    far = torch.full((3, 3, 3), 9.0)
    assert phases.advance(far).tolist() == [0.0, 0.0, 0.0]
    assert not phases.follows_any()
    phases.start(torch.tensor([0, 2]), torch.tensor([0, 0]), torch.tensor([0.0, 0.5]))
    assert (phases.advance(far) > 5.0).tolist() == [True, False, True]
    assert phases.follows_any()
    phases.stop(torch.tensor([2]))
    assert (phases.advance(far) > 5.0).tolist() == [True, False, False]


def test_each_environment_is_compared_with_its_own_clip() -> None:
    """A circle that repeats between half a circle that does not, and a body at rest."""
    rest = body(torch.zeros(PHASES_PER_STEP * 10))
    phases = ClipPhases([clip(LENGTH_S / 2), clip(), rest], 4, DT_S, limit_m=0.3)
    phases.start(torch.arange(4), torch.tensor([0, 1, 2, 2]), torch.zeros(4))
    standing = body(torch.zeros(2 * STEPS))
    moving = body(times(2 * STEPS))
    away_m = torch.stack(
        [
            phases.advance(torch.stack((round_, round_, still, round_)))
            for round_, still in zip(moving, standing, strict=True)
        ]
    )
    half_circle, circle, at_rest, leaves_its_rest = away_m.unbind(dim=1)
    assert half_circle.max() < 0.05
    assert circle.max() < 0.06
    assert at_rest.max() == 0.0
    assert leaves_its_rest.max() > 0.6


FACES_PLUS_Y = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))


def arc(num_phases: int, speed_m_s: float, turn_rad_s: float = 0.0) -> Tensor:
    """Root states (S, 7) of a clip on a circle to the left, or straight on along +x."""
    time_s = DT_S / PHASES_PER_STEP * torch.arange(num_phases)
    angle, zeros = turn_rad_s * time_s, torch.zeros(num_phases)
    if turn_rad_s == 0.0:
        x, y = speed_m_s * time_s, zeros
    else:
        radius_m = speed_m_s / turn_rad_s
        x, y = radius_m * angle.sin(), radius_m * (1.0 - angle.cos())
    half = (zeros, zeros, (angle / 2.0).sin(), (angle / 2.0).cos())
    return torch.stack((x + 5.0, y - 7.0, zeros + 1.0, *half), dim=-1)


SECOND = round(COMPARED_S / DT_S) * PHASES_PER_STEP


def test_a_clip_that_repeats_goes_on_in_its_direction() -> None:
    """Each second of going round a circle is the same chord, over all ends of the clip."""
    for num_phases in [7, 30, 80]:
        for turn_rad_s in [0.0, 2.0, -0.7]:
            found = travel_through(arc(num_phases, 1.3, turn_rad_s), SECOND, repeats=True)
            straight_on_rad = (
                abs(turn_rad_s) * DT_S / PHASES_PER_STEP * math.ceil(SECOND / num_phases)
            )
            chord = torch.tensor([1.3, 0.0])
            if turn_rad_s != 0.0:
                ahead, left = math.sin(turn_rad_s), math.cos(turn_rad_s) - 1.0
                chord = 1.3 / turn_rad_s * torch.tensor([ahead, left])
            torch.testing.assert_close(
                found, chord.expand(num_phases, 2), rtol=0.0, atol=1e-5 + 1.3 * straight_on_rad
            )
            assert num_phases < SECOND or torch.allclose(found[SECOND:], chord, atol=1e-5)


def lags_behind(velocity_w: tuple[float, float], clip_speed: float = 1.0) -> bool:
    """Whether a root that faces +y is behind after a second and a step; its clip goes ahead."""
    points = clip()
    roots = arc(len(points), clip_speed)
    phases = ClipPhases([points], 1, DT_S, 0.3, [roots], travel_share=0.5)
    phases.start(torch.tensor([0]), torch.tensor([0]), torch.tensor([0.0]))
    found = False
    for time_s in times(26):
        phases.advance(body(time_s[None]))
        root = torch.tensor([[*velocity_w, 0.0]]) * time_s + torch.tensor([[3.0, 4.0, 1.0]])
        found = bool(phases.lags_behind(root, torch.tensor([FACES_PLUS_Y])))
    return found


def test_a_second_may_get_less_far_by_a_share_of_the_clips_way() -> None:
    for velocity_w, expected in [
        ((0.0, 1.0), False),
        ((0.0, 0.6), False),
        ((0.0, 0.4), True),
        ((5.0, 0.6), False),
        ((0.0, 1.6), False),
        ((0.0, 0.0), True),
        ((1.0, 0.0), True),
        ((0.0, -1.0), True),
    ]:
        assert lags_behind(velocity_w) is expected


def test_where_the_clip_hardly_travels_resting_is_no_fault() -> None:
    assert not lags_behind((0.0, 0.0), clip_speed=0.25)
    assert lags_behind((0.0, 0.0), clip_speed=0.35)


def limited_phases(
    share: float = 0.3,
    episodes_s: float = 5.0,
    final_limit_m: float | None = None,
    length_s: float = LENGTH_S,
) -> ClipPhases:
    """Phases with limits, after many episodes of that length; the next ones begin."""
    phases = ClipPhases(
        [clip(length_s)],
        1,
        DT_S,
        limit_m=0.3,
        tempo_share=share,
        final_limit_m=final_limit_m,
    )
    for _ in range(12):
        start_all(phases)
        for time_s in times(round(episodes_s / DT_S)):
            phases.advance(body(time_s[None]))
    start_all(phases)
    return phases


def test_episodes_that_end_with_a_clip_are_long_when_they_last_half_of_it() -> None:
    """Half a circle does not close; a quarter of the whole one is half of it."""
    half_s = LENGTH_S / 2
    assert limited_phases(episodes_s=half_s / 2).min_tempo() == 0.5
    ended = limited_phases(episodes_s=half_s * 0.55, length_s=half_s)
    assert ended.min_tempo() == pytest.approx(1 / 1.3)
    fallen = limited_phases(episodes_s=half_s * 0.15, length_s=half_s)
    assert fallen.min_tempo() == 0.5


def start_all(phases: ClipPhases) -> None:
    num_envs = len(phases.is_off_tempo())
    zeros = torch.zeros(num_envs)
    phases.start(torch.arange(num_envs), zeros.long(), zeros)


def is_off_tempo(tempo: float, share: float = 0.3) -> list[bool]:
    """Whether an episode at a tempo of its own is too fast or too slow, step by step."""
    phases = limited_phases(share=share)
    found = []
    for time_s in times(3 * STEPS, tempo):
        phases.advance(body(time_s[None]))
        found.append(bool(phases.is_off_tempo()))
    return found


@pytest.mark.slow
def test_the_tempo_of_an_episode_may_be_off_up_to_a_limit() -> None:
    for tempo, expected in [(0.7, True), (0.85, False), (1.2, False), (1.4, True)]:
        found = is_off_tempo(tempo)
        assert not any(found[: STEPS - 1])  # less than a second
        assert all(found[STEPS:]) is any(found) is expected
    assert not any(is_off_tempo(1.4, share=0.0))


def test_limits_become_narrow_once_episodes_are_long() -> None:
    """Of a second or less: wide. From there to three seconds they narrow evenly."""
    for episodes_s, tempo, limit_m in [(1.0, 0.5, 0.3), (2.0, 0.635, 0.25), (4.0, 0.769, 0.2)]:
        # The mean of twelve such episodes is 0.97 of their length.
        phases = limited_phases(episodes_s=episodes_s / (1.0 - 0.75**12), final_limit_m=0.2)
        assert phases.min_tempo() == pytest.approx(tempo, abs=0.01)  # whole steps: 1 of 50
        assert phases.current_limit_m() == pytest.approx(limit_m, abs=0.004)
    assert limited_phases().current_limit_m() == pytest.approx(0.3)
