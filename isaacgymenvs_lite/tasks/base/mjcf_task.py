"""MjcfTask: a task defined by checked settings and an MJCF file. `VecTask` describes a step."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.schema import read_section
from isaacgymenvs_lite.simulation.backend import make_simulation
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.tasks.base.assets import asset_path, compile_model, hinge_limits
from isaacgymenvs_lite.tasks.base.task_config import (
    UNREAD_ENV_KEYS,
    SimConfig,
    TaskConfig,
    read_num_threads,
    read_sim_config,
)
from isaacgymenvs_lite.tasks.base.vec_task import VecTask


class MjcfTask(VecTask):
    """N simulations of an MJCF file, with checked settings.

    `cfg` is cfg/task/<Task>.yaml as plain dictionaries, and `VecTask` describes the other
    arguments. A task declares the attributes below and implements the methods of `VecTask`.

    Raises:
        ConfigError: a key or value of `task.env` or `task.sim` is invalid.
    """

    settings_class: ClassVar[type[TaskConfig]] = TaskConfig
    """Dataclass that declares the keys of `task.env`."""
    default_asset: ClassVar[str]
    """Path of the task's MJCF, relative to assets/."""
    published_assets: ClassVar[tuple[str, ...]] = ()
    """Published task files use these model names, which select the task's MJCF."""
    max_physics_step_s: ClassVar[float] = math.inf
    """The physics makes more substeps than `task.sim.substeps` if those are longer than this."""
    _spec: mujoco.MjSpec | None = None

    def __init__(self, cfg: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        env = cfg["env"]
        sim = read_sim_config(cfg["sim"])
        substeps = max(sim.substeps, math.ceil(sim.dt / self.max_physics_step_s))
        self.sim_cfg: SimConfig = dataclasses.replace(sim, substeps=substeps)
        self.env_cfg: Any = self.read_settings(env)
        self.max_episode_length = self.episode_length()
        self._model = self.build_model()
        self._layout = ModelLayout.from_model(self._model)
        self.set_sizes()
        env["numObservations"], env["numActions"] = self.num_observations, self.num_actions
        env["numStates"] = self.states_size() if self.env_cfg.asymmetric_observations else 0
        env.setdefault("clipActions", self.env_cfg.clip_actions)
        env.setdefault("controlFrequencyInv", self.env_cfg.control_freq_inv)
        super().__init__(cfg, *args, **kwargs)

    def read_settings(self, env: dict[str, Any]) -> TaskConfig:
        """Return the checked keys of `task.env`; raise ConfigError for an invalid key or value."""
        return read_section(self.settings_class, env, "task.env", ignored=UNREAD_ENV_KEYS)

    def episode_length(self) -> int:
        """Return the number of control steps in an episode."""
        return self.env_cfg.episode_length

    def build_model(self) -> mujoco.MjModel:
        """Return the compiled model."""
        path = self.asset_path()
        friction = self.env_cfg.plane.dynamic_friction

        def keep_and_change(spec: mujoco.MjSpec) -> None:
            self._spec = spec
            self.change_spec(spec)

        return compile_model(path, self.default_asset, self.sim_cfg, friction, keep_and_change)

    def asset_path(self) -> Path:
        """Return the path of the MJCF file that `task.env.asset` names."""
        return asset_path(self.env_cfg.asset, self.default_asset, self.published_assets)

    def scene(self) -> mujoco.MjSpec | None:
        """Return the simulated model as a specification that can be written as MJCF.

        The specification contains the time step, gravity, friction and actuator gains of the
        compiled model. If the task has no specification, the method returns None.
        """
        if self._spec is None:
            return None
        spec, model = self._spec.copy(), self._model
        spec.compile()  # `copy_back` requires a compiled specification
        spec.copy_back(model)
        for actuator in spec.actuators:  # `copy_back` omits these two fields
            actuator.biastype = mujoco.mjtBias(int(model.actuator_biastype[actuator.id]))
            actuator.forcelimited = int(model.actuator_forcelimited[actuator.id])
        spec.compiler.savecompiled = False  # True writes six digits only
        return spec

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Change the specification before it is compiled. The base method does nothing."""

    def set_sizes(self) -> None:
        """Set `num_observations` and `num_actions` if they depend on the model."""

    def states_size(self) -> int:
        """Return the dimension of the privileged observation (see `compute_states`)."""
        return self.num_observations

    def simulator_calls(self) -> int:
        """Return the number of simulator calls, each `sim.dt` long, in a control step."""
        return self.env_cfg.control_freq_inv

    def create_sim(self) -> None:
        """Create the N simulations of the model."""
        self.simulation = make_simulation(
            self._model,
            self.num_envs,
            substeps=self.sim_cfg.substeps * self.simulator_calls(),
            num_threads=read_num_threads(self.cfg["sim"]),
        )

    def find_joints(self, names: Sequence[str]) -> tuple[Tensor, Tensor, Tensor]:
        """Return the columns (k,) of joints in `dof_pos`, and their lower and upper limits (k,)."""
        dofs = [self.simulation.dof_names.index(name) for name in names]
        limits = torch.from_numpy(hinge_limits(self._model, self._layout)[dofs]).float()
        lower, upper = limits.to(self.device).unbind(-1)
        return torch.tensor(dofs, device=self.device), lower, upper
