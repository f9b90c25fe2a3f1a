"""Each function by hand, with random numbers that the test chooses."""

from __future__ import annotations

import random

import pytest

from isaacgymenvs_lite.pbt.mutation import get_mutation_func, mutate


class Chosen(random.Random):
    """A factor at a share of the range; then up or down."""

    def __init__(self, share: float, up: bool) -> None:
        super().__init__()
        self._share, self._up = share, up

    def uniform(self, a, b):
        return a + self._share * (b - a)

    def random(self):
        return 0.25 if self._up else 0.75


UP, DOWN = Chosen(0.5, up=True), Chosen(0.5, up=False)
MOST_UP, MOST_DOWN = Chosen(1.0, up=True), Chosen(1.0, up=False)


def test_a_function():
    for name, value, rng, expected in [
        # The factor is 1.3, in the middle of 1.1 and 1.5.
        ("mutate_float", 2.0, UP, 2.6),
        ("mutate_float", 2.6, DOWN, 2.0),
        ("mutate_float", -2.0, UP, -2.6),
        ("mutate_float", 0.0, UP, 0.0),
        ("mutate_float", 2.0, MOST_UP, 3.0),
        ("mutate_float", 2.0, Chosen(0.0, up=True), 2.2),
        ("mutate_float_min_1", 2.0, UP, 2.6),
        ("mutate_float_min_1", 1.2, DOWN, 1.0),
        ("mutate_float_min_1", 1.0, MOST_DOWN, 1.0),
        ("mutate_eps_clip", 0.2, UP, 0.26),
        ("mutate_eps_clip", 0.25, UP, 0.3),
        ("mutate_eps_clip", 0.012, DOWN, 0.01),
        ("mutate_mini_epochs", 4, UP, 5),
        ("mutate_mini_epochs", 4, DOWN, 3),
        ("mutate_mini_epochs", 1, DOWN, 1),
        ("mutate_mini_epochs", 8, UP, 8),
        # The factor of 1 - x is 1.15, in the middle of 1.1 and 1.2.
        ("mutate_discount", 0.99, UP, 1 - 0.0115),
        ("mutate_discount", 0.99, DOWN, 1 - 0.01 / 1.15),
        ("mutate_discount", 1.0, UP, 1.0),
        ("mutate_discount", 0.1, MOST_UP, 0.0),
    ]:
        result = get_mutation_func(name)(value, change_min=1.1, change_max=1.5, rng=rng)
        assert result == pytest.approx(expected)
        assert isinstance(result, type(value))


def test_bounds_and_both_directions():
    for name, value, low, high in [
        ("mutate_float", 3.0, 3.0 / 1.5, 3.0 * 1.5),
        ("mutate_float_min_1", 1.3, 1.0, 1.3 * 1.5),
        ("mutate_eps_clip", 0.25, 0.25 / 1.5, 0.3),
        ("mutate_mini_epochs", 5, 4, 6),
        ("mutate_discount", 0.99, 1 - 0.012, 1 - 0.01 / 1.2),
    ]:
        rng = random.Random(0)
        results = [get_mutation_func(name)(value, rng=rng) for _ in range(500)]
        assert low - 1e-12 <= min(results) < value < max(results) <= high + 1e-12
        assert 0.4 < sum(result > value for result in results) / len(results) < 0.6


def test_the_rate_is_the_share_that_changes():
    params = {f"x{n}": 1.0 for n in range(2000)}
    functions = dict.fromkeys(params, "mutate_float")
    for rate in (0.0, 0.15, 1.0):
        mutated = mutate(params, functions, rate, 1.1, 1.5, random.Random(1))
        share = sum(mutated[name] != 1.0 for name in params) / len(params)
        assert share == pytest.approx(rate, abs=0.03)
    assert set(params.values()) == {1.0}


def test_the_same_generator_gives_the_same_settings():
    params, functions = {"a": 1.0, "b": 2.0}, dict.fromkeys("ab", "mutate_float")
    first, second = (mutate(params, functions, 1.0, 1.1, 1.5, random.Random("7")) for _ in "12")
    assert first == second != mutate(params, functions, 1.0, 1.1, 1.5, random.Random("8"))
