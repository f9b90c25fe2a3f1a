"""From a backend's name to a simulation; each backend is imported only when it is asked for."""

from __future__ import annotations

from collections.abc import Callable

import mujoco

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.simulation.backend import SimulationBackend


def _cpu_batch(
    model: mujoco.MjModel, num_envs: int, substeps: int, num_threads: int
) -> SimulationBackend:
    from isaacgymenvs_lite.simulation.cpu_batch import CpuBatchSimulation

    return CpuBatchSimulation(model, num_envs, substeps, num_threads)


_BACKENDS: dict[str, Callable[[mujoco.MjModel, int, int, int], SimulationBackend]] = {
    "cpu_batch": _cpu_batch,
}


def backend_names() -> list[str]:
    """Names that `make_simulation` accepts."""
    return sorted(_BACKENDS)


def make_simulation(
    model: mujoco.MjModel,
    num_envs: int,
    substeps: int,
    num_threads: int = 0,
    backend: str = "cpu_batch",
) -> SimulationBackend:
    """Make `num_envs` simulations of `model`.

    Args:
        model: the compiled model.
        num_envs: number of simulations.
        substeps: physics steps of one control step.
        num_threads: CPU worker threads; 0 for as many CPUs as have enough to do.
        backend: one of `backend_names()`.

    Raises:
        ConfigError: an unknown backend or a number out of range.
    """
    if backend not in _BACKENDS:
        raise ConfigError(unknown("simulation backend", backend, backend_names()))
    return _BACKENDS[backend](model, num_envs, substeps, num_threads)
