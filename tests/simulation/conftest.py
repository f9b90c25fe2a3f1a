"""Models and simulations that the simulation tests share."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import mujoco
import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.simulation.cpu_batch import CpuBatchSimulation
from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import HumanoidAMPBase

MakeSimulation = Callable[..., CpuBatchSimulation]
RandomState = Callable[[int, int], tuple[Tensor, Tensor, Tensor]]

# Every type of joint, several on one body, anchors beside the origin, turned bodies, references,
# bodies without joints below and above bodies with some, two trees.
MADE_UP = """
<mujoco><compiler angle="radian"/><worldbody>
  <body name="drone" pos="1 2 3" quat="0.5 0.5 -0.5 0.5"><freejoint/><geom size="0.1"/>
    <body name="mast" pos="0.1 0.2 0.3" euler="0.4 -0.2 0.7"><geom size="0.1"/>
      <body name="arm" pos="0 0.1 0.5" euler="0.1 0.2 0.3">
        <joint type="slide" axis="1 2 -1" pos="0.3 0 0" ref="0.2"/>
        <joint type="hinge" axis="0 1 1" pos="0.1 -0.2 0.3" ref="-0.4"/>
        <joint type="slide" axis="0 0 1"/>
        <geom size="0.1"/>
        <body name="hand" pos="0.4 0 0"><joint type="ball" pos="0.05 0.02 -0.1"/><geom size="0.1"/>
          <body name="finger" pos="0 0 0.2"><geom size="0.1"/></body></body>
      </body>
      <body name="tail" pos="0 -0.3 0"><joint type="ball"/><joint type="slide" axis="0 1 0"/>
        <geom size="0.1"/></body>
    </body>
  </body>
  <body name="post" pos="-1 0 0.5" euler="0 0 1"><geom size="0.1"/>
    <body name="door" pos="0.2 0 0">
      <joint type="hinge" axis="1 0 0"/><joint type="hinge" axis="0 0 1" pos="0.1 0.1 0"/>
      <geom size="0.1"/></body></body>
</worldbody></mujoco>
"""


@pytest.fixture(scope="session")
def made_up_model() -> mujoco.MjModel:
    """A model with all types of joints (`MADE_UP`); do not change it."""
    model = mujoco.MjModel.from_xml_string(MADE_UP)
    assert set(model.jnt_type) == {0, 1, 2, 3}
    return model


@pytest.fixture(scope="session")
def humanoid_model() -> mujoco.MjModel:
    """The AMP humanoid with the published keys; do not change it."""
    task = HumanoidAMPBase({"env": {"numEnvs": 1}, "sim": {"dt": 0.0166}}, "cpu", "cpu", -1, True)
    task.close()
    return task.simulation.model


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
