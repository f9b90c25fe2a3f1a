"""Models and simulations that the simulation tests share."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import mujoco
import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.simulation.cpu_batch import CpuBatchSimulation

MakeSimulation = Callable[..., CpuBatchSimulation]
RandomState = Callable[[int, int], tuple[Tensor, Tensor, Tensor]]


@pytest.fixture
def make_simulation() -> Iterator[MakeSimulation]:
    """Return a maker of simulations of a model or of an MJCF string, closed after the test."""
    made: list[CpuBatchSimulation] = []

    def make(
        model: mujoco.MjModel | str, num_envs: int = 1, substeps: int = 1, num_threads: int = 1
    ) -> CpuBatchSimulation:
        if isinstance(model, str):
            model = mujoco.MjModel.from_xml_string(model)
        made.append(CpuBatchSimulation(model, num_envs, substeps, num_threads))
        return made[-1]

    yield make
    for simulation in made:
        simulation.close()


@pytest.fixture
def random_state() -> RandomState:
    """Return `random_state(n, seed)`: states of the humanoid, root somewhere above the floor."""

    def draw(n: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
        generator = torch.Generator().manual_seed(seed)
        root = torch.randn(n, 13, generator=generator)
        root[:, 2] = 1.5 + root[:, 2].abs()
        root[:, 3:7] /= root[:, 3:7].norm(dim=-1, keepdim=True)
        # Rotation vectors stay shorter than pi, where they are unique.
        dof_pos = 1.8 * (2.0 * torch.rand(n, 28, generator=generator) - 1.0)
        return root, dof_pos, torch.randn(n, 28, generator=generator)

    return draw
