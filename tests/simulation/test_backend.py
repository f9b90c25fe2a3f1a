from __future__ import annotations

import subprocess
import sys

import mujoco
import pytest

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.simulation.backend import make_simulation
from isaacgymenvs_lite.simulation.cpu_batch import CpuBatchSimulation

BALL = """<mujoco><worldbody><body name="ball" pos="0 0 1"><freejoint/><geom size="0.1"/></body>
</worldbody></mujoco>"""


def test_makes_cpu_batch_by_default() -> None:
    model = mujoco.MjModel.from_xml_string(BALL)
    simulation = make_simulation(model, 3, substeps=2, num_threads=1)
    assert isinstance(simulation, CpuBatchSimulation)
    assert (simulation.num_envs, simulation.substeps) == (3, 2)
    assert simulation.model is model
    simulation.close()


def test_an_unknown_backend_lists_the_choices() -> None:
    model = mujoco.MjModel.from_xml_string(BALL)
    with pytest.raises(ConfigError, match=r"'cpu_bach'.*did you mean 'cpu_batch'.*choices: cpu_b"):
        make_simulation(model, 1, 1, backend="cpu_bach")


def test_backends_are_imported_only_when_asked_for() -> None:
    code = (
        "import sys, isaacgymenvs_lite.simulation.backend;"
        "sys.exit('isaacgymenvs_lite.simulation.cpu_batch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
