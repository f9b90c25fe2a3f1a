"""Numbers of domain randomisation under their published names."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.errors import UnavailableError
from isaacgymenvs_lite.isaacgymenvs_compat import dr_utils

UNIFORM = {"range": [0.5, 1.5], "operation": "scaling", "distribution": "uniform"}


def test_numbers_are_drawn_on_their_schedule() -> None:
    torch.manual_seed(0)
    scheduled = {**UNIFORM, "schedule": "linear", "schedule_steps": 100}
    drawn = dr_utils.generate_random_samples(UNIFORM, (1000, 2), 0)
    assert drawn.shape == (1000, 2)
    assert 0.5 <= drawn.min() < 0.51 < 1.49 < drawn.max() <= 1.5
    assert (dr_utils.generate_random_samples(scheduled, 5, 0) == 1.0).all()
    half = dr_utils.generate_random_samples(scheduled, 1000, 50)
    assert 0.75 <= half.min() < 0.76 < 1.24 < half.max() <= 1.25


def test_numbers_drawn_elsewhere_are_put_on_the_schedule() -> None:
    half = {**UNIFORM, "schedule": "linear", "schedule_steps": 10}
    scaled = dr_utils.generate_random_samples(half, 2, 5, extern_sample=[2.0, 0.5])
    np.testing.assert_allclose(scaled, [1.5, 0.75])
    half["operation"] = "additive"
    added = dr_utils.generate_random_samples(half, 2, 5, extern_sample=[2.0, -0.5])
    np.testing.assert_allclose(added, [1.0, -0.25])


def test_buckets_round_down() -> None:
    buckets = {**UNIFORM, "num_buckets": 4}
    values = [0.5, 0.74, 0.76, 1.3, 1.49, 9.0, 0.1]
    expected = [0.5, 0.5, 0.75, 1.25, 1.25, 1.25, 0.5]
    np.testing.assert_allclose(dr_utils.get_bucketed_val(values, buckets), expected)


def test_what_calls_the_simulator_says_what_does_it_here() -> None:
    for name in ("apply_random_samples", "check_buckets", "get_property_setter_map"):
        with pytest.raises(
            UnavailableError, match=rf"dr_utils\.{name}: .*task.task.randomize=True"
        ):
            getattr(dr_utils, name)(None)
