from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from isaacgymenvs_lite.tasks.base.humanoid_observations import (
    all_body_observation_groups,
    compute_all_body_observations,
)

N, B = 6, 4


@pytest.fixture
def bodies() -> tuple[np.ndarray, ...]:
    """Positions, rotations (xyzw), linear and angular velocities of random bodies."""
    rng = np.random.default_rng(0)
    rotations = Rotation.random(N * B, random_state=1).as_quat().reshape(N, B, 4)
    return rng.normal(size=(N, B, 3)), rotations, *rng.normal(size=(2, N, B, 3))


def observed(bodies: tuple[np.ndarray, ...], *flags: bool) -> np.ndarray:
    tensors = [torch.from_numpy(quantity).float() for quantity in bodies]
    return compute_all_body_observations(*tensors, *flags).double().numpy()


def expected(bodies: tuple[np.ndarray, ...], keep_root_heading: bool, height: bool) -> np.ndarray:
    """The same by scipy's rotations, environment by environment."""
    rows = []
    for pos, rot, lin, ang in zip(*bodies, strict=True):
        forward = Rotation.from_quat(rot[0]).apply([1.0, 0.0, 0.0])
        back = Rotation.from_euler("z", -np.arctan2(forward[1], forward[0]))
        local = [back * Rotation.from_quat(q) for q in rot]
        if keep_root_heading:
            local[0] = Rotation.from_quat(rot[0])
        rows.append(
            np.concatenate(
                [
                    [pos[0, 2] if height else 0.0],
                    *(back.apply(p - pos[0]) for p in pos[1:]),
                    *(np.concatenate([r.apply([1, 0, 0]), r.apply([0, 0, 1])]) for r in local),
                    *(back.apply(v) for v in lin),
                    *(back.apply(w) for w in ang),
                ]
            )
        )
    return np.stack(rows)


def test_against_an_independent_formula(bodies):
    for local_root_obs in [True, False]:
        for height in [True, False]:
            found = observed(bodies, local_root_obs, height)
            assert found.shape == (N, sum(all_body_observation_groups(B).values()))
            # float32 rotations of numbers of about 1
            np.testing.assert_allclose(found, expected(bodies, local_root_obs, height), atol=2e-6)


def test_sizes_of_the_published_characters():
    sizes = [sum(all_body_observation_groups(bodies).values()) for bodies in (15, 17)]
    assert sizes == [223, 253]


def test_the_example_of_a_rotation():
    """Heading 0.627 rad taken out of normalise(0.1, -0.2, 0.3, 0.9)."""
    rotation = np.array([0.1, -0.2, 0.3, 0.9]) / np.sqrt(0.95)
    one = np.zeros((1, 1, 3))
    bodies = (one, rotation[None, None], one + np.array([1.0, 0.2, 0.1]), one)
    found = observed(bodies, False)[0]
    local = [0.896963, 0.0, 0.442105, -0.441008, -0.070413, 0.894737]
    np.testing.assert_allclose(found[1:7], local, atol=2e-6)
    np.testing.assert_allclose(found[7:10], [0.927105, -0.424825, 0.1], atol=2e-6)
    world = [0.726316, 0.526316, 0.442105, -0.315789, -0.315789, 0.894737]
    np.testing.assert_allclose(observed(bodies, True)[0, 1:7], world, atol=2e-6)
