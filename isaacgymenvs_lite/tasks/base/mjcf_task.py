"""MjcfTask: a task from checked keys and an MJCF file. See `VecTask` for the life of a step."""

from __future__ import annotations

from typing import Any, ClassVar

import mujoco

from isaacgymenvs_lite.schema import read_section
from isaacgymenvs_lite.simulation.backend import make_simulation
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.tasks.base.assets import asset_path, compile_model
from isaacgymenvs_lite.tasks.base.task_config import (
    UNREAD_ENV_KEYS,
    SimConfig,
    TaskConfig,
    read_num_threads,
    read_sim_config,
)
from isaacgymenvs_lite.tasks.base.vec_task import VecTask


class MjcfTask(VecTask):
    """N simulations of an MJCF file, with checked keys.

    A task declares the attributes that follow and fills in the methods of `VecTask`.

    Args:
        cfg: cfg/task/<Task>.yaml as plain dictionaries.
        args: the other arguments of `VecTask`.
        kwargs: likewise, by name.

    Attributes:
        settings_class: dataclass of the keys of `task.env`.
        default_asset: the task's MJCF, relative to assets/.
        published_assets: names of the model in published task files.
        actor_name: name of the robot in `task.task.randomization_params.actor_params`.
        num_observations: numbers in an observation.
        num_actions: numbers in an action.
        env_cfg: the keys of `task.env`, an object of `settings_class`.
        sim_cfg: the keys of `task.sim`.

    Raises:
        ConfigError: a key or value of `task.env` or `task.sim` that cannot be used.
    """

    settings_class: ClassVar[type[TaskConfig]] = TaskConfig
    default_asset: ClassVar[str]
    published_assets: ClassVar[tuple[str, ...]] = ()
    _spec: mujoco.MjSpec | None = None

    def __init__(self, cfg: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        env = cfg["env"]
        self.sim_cfg: SimConfig = read_sim_config(cfg["sim"])
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
        """Check `task.env`.

        Raises:
            ConfigError: an unknown, ill-typed or impossible value.
        """
        return read_section(self.settings_class, env, "task.env", ignored=UNREAD_ENV_KEYS)

    def episode_length(self) -> int:
        """Return the control steps of an episode: by default the setting of this name."""
        return self.env_cfg.episode_length

    def build_model(self) -> mujoco.MjModel:
        """Return the compiled model."""
        path = asset_path(self.env_cfg.asset, self.default_asset, self.published_assets)
        friction = self.env_cfg.plane.dynamic_friction

        def keep_and_change(spec: mujoco.MjSpec) -> None:
            self._spec = spec
            self.change_spec(spec)

        return compile_model(path, self.default_asset, self.sim_cfg, friction, keep_and_change)

    def scene(self) -> mujoco.MjSpec | None:
        """Return the simulated model as a specification, which can be written as MJCF.

        Its numbers are the compiled model's: time step, gravity, friction, gains of the actuators.
        None if the task did not keep it.
        """
        if self._spec is None:
            return None
        spec, model = self._spec.copy(), self._model
        spec.compile()  # `copy_back` compares the model with what the specification compiles to
        spec.copy_back(model)
        for actuator in spec.actuators:  # what `copy_back` leaves as it was
            actuator.biastype = mujoco.mjtBias(int(model.actuator_biastype[actuator.id]))
            actuator.forcelimited = int(model.actuator_forcelimited[actuator.id])
        spec.compiler.savecompiled = False  # or MJCF is written with six digits
        return spec

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Change the task's MJCF before it is compiled; nothing by default."""

    def set_sizes(self) -> None:
        """Set `num_observations` and `num_actions` if they depend on the model."""

    def states_size(self) -> int:
        """Return how many numbers an asymmetric critic observes, see `compute_states`."""
        return self.num_observations

    def simulator_calls(self) -> int:
        """Return the simulator calls of `sim.dt` in a control step."""
        return self.env_cfg.control_freq_inv

    def create_sim(self) -> None:
        """Make the N simulations of the model."""
        self.simulation = make_simulation(
            self._model,
            self.num_envs,
            substeps=self.sim_cfg.substeps * self.simulator_calls(),
            num_threads=read_num_threads(self.cfg["sim"]),
        )
