"""Describes an exported policy so that its file alone is enough to control a robot."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import torch
from omegaconf import DictConfig

from isaacgymenvs_lite import __version__
from isaacgymenvs_lite.export.exportable_policy import PolicyGraph, TensorSpec
from isaacgymenvs_lite.learning.hrl_players import HRLPlayer
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.simulation.state_buffers import StateConverter
from isaacgymenvs_lite.tasks.base.vec_task import VecTask

FORMAT_VERSION = 2
"""Version of the keys that `describe` returns."""


def describe(
    cfg: DictConfig, player: Any, graph: PolicyGraph, state: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the metadata of an exported policy; all values can be written as JSON.

    `cfg` is the policy's composed tree, and `state` is the content of the policy's checkpoint.
    """
    task: VecTask = player.env
    option = task.simulation.model.opt
    scaling = task.action_scaling()
    largest = float(task.act_space.high.max()) if player.clip_actions else math.inf
    described: dict[str, Any] = {
        "format_version": FORMAT_VERSION,
        "project": "isaacgymenvs_lite",
        "project_version": __version__,
        "task": str(cfg.task.name),
        "algorithm": str(cfg.train.params.algo.name),
        "frames": int(state.get("frame", 0)),
        "epochs": int(state.get("epoch", 0)),
        "control_rate_hz": 1.0 / task.simulation.dt,
        "simulation": {
            "timestep_s": option.timestep,
            "steps_per_action": task.simulation.substeps,
            "gravity": option.gravity.tolist(),
            "integrator": _enum_name(mujoco.mjtIntegrator(option.integrator)),
        },
        "inputs": [_described(spec) for spec in graph.inputs],
        "outputs": [_described(spec) for spec in graph.outputs],
        "observations": _observations(task),
        "observation_limit": _finite(task.clip_obs),
        "actions": _action_names(task),
        "action_limit": _finite(min(task.clip_actions, largest)),
        "action_scaling": scaling
        and {
            "unit": scaling.unit,
            "offset": scaling.offset.tolist(),
            "scale": scaling.scale.tolist(),
        },
        "drives": drives_of(task.simulation.model),
        **_robot(task),
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
    described = task.robot_description()
    frames = described.frames if described else {}
    starts = itertools.accumulate(groups.values(), initial=0)
    parts = []
    for (group, size), start in zip(groups.items(), starts, strict=False):
        # In a history, `dof_vel_2` is the `dof_vel` of two control steps ago.
        stem, _, number = group.rpartition("_")
        is_older = number.isdecimal() and stem in groups
        name, age = (stem, int(number)) if is_older else (group, 0)
        frame = frames.get(name)
        parts.append({"name": name, "age": age, "start": start, "size": size, "frame": frame})
    return parts


def _enum_name(value: Any) -> str:
    """Return a short name of an enum value, for example `hinge` for mjJNT_HINGE."""
    return value.name.partition("_")[2].lower()


def _robot(task: VecTask) -> dict[str, Any]:
    """Return joints, root and key bodies of the robot; missing values are null or empty.

    All values are in MuJoCo's coordinates: the root has a position (m), a quaternion wxyz, a linear
    velocity in world axes (m/s) and an angular velocity in the root's axes (rad/s). Hinges have
    angles (rad), ball joints have quaternions wxyz.
    """
    model, described = task.simulation.model, task.robot_description()
    layout = ModelLayout.from_model(model)
    states: dict[str, npt.NDArray[np.float64]] = {}
    if described is not None:
        both = (torch.stack(tensors).cpu() for tensors in zip(*described[:2], strict=True))
        qpos, qvel = StateConverter(model, layout).rows(*both)
        states = {"default_qpos": qpos[0], "start_qpos": qpos[1], "start_qvel": qvel[1]}
    joints = []
    for i in range(model.njnt - len(layout.object_names)):
        joint = model.joint(i)
        kind = mujoco.mjtJoint(int(joint.type[0]))
        described_joint: dict[str, Any] = {"name": joint.name, "type": _enum_name(kind)}
        for key, values in states.items():
            is_qpos = key.endswith("qpos")
            first = int((joint.qposadr if is_qpos else joint.dofadr)[0])
            size = len(joint.qpos0) if is_qpos else len(joint.damping)
            described_joint[key] = values[first : first + size].tolist()
        joints.append(described_joint)
    has_root = layout.has_free_root
    return {
        "root": {"body": layout.body_names[0], **joints[0]} if has_root and described else None,
        "joints": joints[1:] if has_root else joints,
        "key_bodies": list(described.key_bodies) if described else [],
    }


def _action_names(task: VecTask) -> list[str]:
    model = task.simulation.model
    if model.nu != task.num_actions:
        return [f"action_{i}" for i in range(task.num_actions)]
    return [model.actuator(i).name or f"action_{i}" for i in range(model.nu)]


def drives_of(model: mujoco.MjModel) -> list[dict[str, Any]]:
    """Return name, stiffness, damping (0 for motors) and effort limit (or None) of all actuators.

    The units of stiffness, damping and effort limit are Nm/rad, Nm s/rad and Nm for hinges and ball
    joints, and N/m, N s/m and N for slides. The entry of an actuator on a joint also contains the
    joint's name, the joint's armature (in kg for slides, otherwise in kg m^2) and the first three
    values of the gear. For a ball joint the gear is the torque's axis in the body's frame.
    """
    drives = []
    for i in range(model.nu):
        is_servo = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        limited = bool(model.actuator_forcelimited[i])
        is_on_joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        joint = int(model.actuator_trnid[i, 0])
        armature = float(model.dof_armature[model.jnt_dofadr[joint]]) if is_on_joint else None
        drives.append(
            {
                "name": model.actuator(i).name,
                "joint": model.joint(joint).name if is_on_joint else None,
                "gear": model.actuator_gear[i, :3].tolist() if is_on_joint else None,
                "stiffness": float(model.actuator_gainprm[i, 0]) if is_servo else 0.0,
                "damping": float(-model.actuator_biasprm[i, 2]) if is_servo else 0.0,
                "effort_limit": float(model.actuator_forcerange[i, 1]) if limited else None,
                "armature": armature,
            }
        )
    return drives
