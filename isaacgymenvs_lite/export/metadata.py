"""Describes an exported policy, so that the file is all that it takes to drive a robot."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import mujoco
from omegaconf import DictConfig

from isaacgymenvs_lite import __version__
from isaacgymenvs_lite.export.exportable_policy import PolicyGraph, TensorSpec
from isaacgymenvs_lite.learning.hrl_players import HRLPlayer
from isaacgymenvs_lite.tasks.base.vec_task import VecTask

FORMAT_VERSION = 1
"""Of the keys that `describe` returns."""


def describe(
    cfg: DictConfig, player: Any, graph: PolicyGraph, state: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the metadata of an exported policy; all values can be written as JSON.

    Args:
        cfg: the composed tree that the policy is played with.
        player: of the policy.
        graph: of the policy.
        state: of its checkpoint.
    """
    task: VecTask = player.env
    described: dict[str, Any] = {
        "format_version": FORMAT_VERSION,
        "project": "isaacgymenvs_lite",
        "project_version": __version__,
        "task": str(cfg.task.name),
        "algorithm": str(cfg.train.params.algo.name),
        "frames": int(state.get("frame", 0)),
        "epochs": int(state.get("epoch", 0)),
        "control_rate_hz": 1.0 / task.simulation.dt,
        "inputs": [_described(spec) for spec in graph.inputs],
        "outputs": [_described(spec) for spec in graph.outputs],
        "observations": _observations(task),
        "observation_limit": _finite(task.clip_obs),
        "actions": _action_names(task),
        "action_limit": _finite(min(task.clip_actions, 1.0 if player.clip_actions else math.inf)),
        "action_scaling": _action_scaling(task),
        "drives": drives_of(task.simulation.model),
    }
    if isinstance(player, HRLPlayer):
        described["llc_steps"] = player.llc_steps
        described["llc"] = player.llc.reference["checkpoint"]
    return described


def _described(spec: TensorSpec) -> dict[str, Any]:
    axis = spec.batch_axis
    shape = [*spec.shape[:axis], "batch", *spec.shape[axis:]]
    return {"name": spec.name, "shape": shape, "dtype": str(spec.dtype).removeprefix("torch.")}


def _finite(limit: float) -> float | None:
    return limit if math.isfinite(limit) else None


def _observations(task: VecTask) -> list[dict[str, Any]]:
    groups = task.observation_groups() or {f"obs_{i}": 1 for i in range(task.num_obs)}
    starts = itertools.accumulate(groups.values(), initial=0)
    return [
        {"name": name, "start": start, "size": size}
        for (name, size), start in zip(groups.items(), starts, strict=False)
    ]


def _action_names(task: VecTask) -> list[str]:
    model = task.simulation.model
    if model.nu != task.num_actions:
        return [f"action_{i}" for i in range(task.num_actions)]
    return [model.actuator(i).name or f"action_{i}" for i in range(model.nu)]


def _action_scaling(task: VecTask) -> dict[str, Any] | None:
    scaling = task.action_scaling()
    if scaling is None:
        return None
    offset, scale = scaling.offset.tolist(), scaling.scale.tolist()
    return {"unit": scaling.unit, "offset": offset, "scale": scale}


def drives_of(model: mujoco.MjModel) -> list[dict[str, Any]]:
    """Return the actuators: name, stiffness, damping (0 of motors), effort limit (None: without).

    In Nm/rad, Nm s/rad and Nm of hinges and ball joints; N/m, N s/m and N of slides.
    """
    drives = []
    for i in range(model.nu):
        is_servo = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        limited = bool(model.actuator_forcelimited[i])
        drives.append(
            {
                "name": model.actuator(i).name,
                "stiffness": float(model.actuator_gainprm[i, 0]) if is_servo else 0.0,
                "damping": float(-model.actuator_biasprm[i, 2]) if is_servo else 0.0,
                "effort_limit": float(model.actuator_forcerange[i, 1]) if limited else None,
            }
        )
    return drives
