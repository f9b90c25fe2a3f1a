"""HumanoidAMPBase: the simulated humanoid of AMP without reference motions, and its settings."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any, ClassVar

import mujoco
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.motion.interpolation import INTERPOLATIONS
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.tasks.base.assets import hinge_limits, shipped_assets
from isaacgymenvs_lite.tasks.base.humanoid_observations import (
    compute_humanoid_falls,
    compute_humanoid_observations,
    compute_humanoid_reset,
    compute_humanoid_reward,
    dof_to_obs,
    num_humanoid_obs,
    pd_action_offset_scale,
)
from isaacgymenvs_lite.tasks.base.mjcf_task import MjcfTask
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.task_config import AssetConfig, TaskConfig
from isaacgymenvs_lite.tasks.base.vec_task import (
    ActionScaling,
    Done,
    RobotDescription,
    RobotState,
)

__all__ = [
    "DOF_BODY_IDS",
    "DOF_OFFSETS",
    "KEY_BODY_NAMES",
    "NUM_ACTIONS",
    "NUM_OBS",
    "HumanoidAMPBase",
    "compute_humanoid_observations",
    "compute_humanoid_reset",
    "compute_humanoid_reward",
    "dof_to_obs",
]

log = logging.getLogger(__name__)

# Scripts use these constants of IsaacGymEnvs' humanoid. This project's tasks read the model.
DOF_BODY_IDS = [1, 2, 3, 4, 6, 7, 9, 10, 11, 12, 13, 14]
DOF_OFFSETS = [0, 3, 6, 9, 10, 13, 14, 17, 18, 21, 24, 25, 28]
NUM_OBS = 105
NUM_ACTIONS = 28
KEY_BODY_NAMES = ("right_hand", "left_hand", "right_foot", "left_foot")
OWN_ASSET = "mjcf/amp_humanoid.xml"
FEET = ("right_foot", "left_foot")
_START_HEIGHT_M = 0.89

CharacterState = tuple[Tensor, Tensor, Tensor, Tensor]
"""Root states (..., 13), DOF positions and velocities (..., D), key body positions (..., K, 3)."""


@dataclass(frozen=True, kw_only=True)
class HumanoidAMPConfig(TaskConfig):
    """`task.env` of HumanoidAMP. The file cfg/task/HumanoidAMP.yaml describes the keys."""

    episode_length: int = setting(300, key="episodeLength", minimum=2)
    pd_control: bool = setting(True, key="pdControl")
    power_scale: float = setting(1.0, key="powerScale", minimum=0)
    control_freq_inv: int = setting(2, key="controlFrequencyInv", minimum=1)
    state_init: str = setting(
        "Random", key="stateInit", choices=("Default", "Start", "Random", "Hybrid")
    )
    hybrid_init_prob: float = setting(0.5, key="hybridInitProb", minimum=0, maximum=1)
    num_amp_obs_steps: int = setting(2, key="numAMPObsSteps", minimum=2, maximum=1000)
    local_root_obs: bool = setting(False, key="localRootObs")
    contact_bodies: tuple[str, ...] | None = setting(FEET, key="contactBodies")
    termination_height: float = setting(0.5, key="terminationHeight")  # m
    enable_early_termination: bool = setting(True, key="enableEarlyTermination")
    motion_file: str = setting("walk.npz")
    repair_repeated_frames: bool = setting(True, key="repairRepeatedFrames")
    clip_interpolation: str = setting("spline", key="clipInterpolation", choices=INTERPOLATIONS)
    demo_motion_share: float = setting(0.0, key="demoMotionShare", minimum=0, maximum=1)
    adaptive_starts: float = setting(0.0, key="adaptiveStarts", minimum=0, maximum=1)
    clip_deviation: float = setting(0.0, key="clipDeviation", minimum=0)
    clip_deviation_final: float = setting(0.0, key="clipDeviationFinal", minimum=0)
    clip_travel: float = setting(0.0, key="clipTravel", minimum=0, maximum=1)
    clip_tempo: float = setting(0.0, key="clipTempo", minimum=0)
    end_with_clip: bool = setting(False, key="endWithClip")
    ground_clips: bool = setting(False, key="groundClips")
    enforce_effort_limits: bool = setting(False, key="enforceEffortLimits")
    asset: AssetConfig = field(default_factory=lambda: AssetConfig(OWN_ASSET))


def dof_limits(model: mujoco.MjModel, layout: ModelLayout) -> npt.NDArray[np.float64]:
    """Return the lower and upper limits (D, 2) of a humanoid's degrees of freedom in rad.

    MuJoCo limits only the total angle of a ball joint. The limits of a ball joint's rotation vector
    are the length ranges of its three actuators, or 0 if the file has no length ranges. Actuators
    have the order of the degrees of freedom.
    """
    limits = hinge_limits(model, layout)
    balls = layout.ball_dofs.ravel()
    limits[balls] = model.actuator_lengthrange[balls]
    return limits


def set_actuators(model: mujoco.MjModel, env: HumanoidAMPConfig) -> None:
    """Set the actuator type and effort limits of a compiled model."""
    if not env.pd_control:  # controls are torques (Nm) without effort limits
        model.actuator_gainprm[:, 0] = 1.0
        model.actuator_biastype[:] = int(mujoco.mjtBias.mjBIAS_NONE)
        model.actuator_biasprm[:] = 0.0
        model.actuator_forcelimited[:] = 0
        return
    # MuJoCo 4 wraps the error of a position servo on a ball joint into +-pi. A full action is pi in
    # float32, which exceeds pi and would rotate the joint backwards. MuJoCo recognises a servo by
    # gain = -bias, so a bias with another last bit avoids the wrapping.
    model.actuator_biasprm[:, 1] = np.nextafter(model.actuator_biasprm[:, 1], 0.0)
    if not env.enforce_effort_limits:
        model.actuator_forcelimited[:] = 0


# inference_mode saves autograd's bookkeeping, a tenth of the time for small tensors.


class HumanoidAMPBase(MjcfTask):
    """N humanoids with 105 observations, and with 28 PD targets or torques as actions.

    docs/amp.md lists the differences from IsaacGymEnvs. A contact force in any direction can mean a
    fall. The observation after a reset describes the new state. The default pose is the zero pose,
    whereas IsaacGymEnvs' default pose crosses the arms.
    """

    settings_class = HumanoidAMPConfig
    default_asset = OWN_ASSET
    actor_name = "humanoid"
    starts_before_physics = True
    agents_call_reset_done = True
    num_dofs_of_assets: ClassVar[tuple[int, ...]] = (NUM_ACTIONS,)
    """Supported numbers of degrees of freedom. An empty tuple supports all numbers."""

    def build_model(self) -> mujoco.MjModel:
        """Return the compiled model with the configured actuators."""
        model = super().build_model()
        set_actuators(model, self.env_cfg)
        return model

    def key_body_names(self) -> tuple[str, ...]:
        """Return the bodies whose positions are observed."""
        return KEY_BODY_NAMES

    def contact_body_names(self) -> tuple[str, ...]:
        """Return the bodies that may touch the floor in every clip."""
        bodies: tuple[str, ...] | None = self.env_cfg.contact_bodies
        return FEET if bodies is None else bodies

    def set_sizes(self) -> None:
        """Set the sizes of observations and actions."""
        self.num_observations = sum(self.observation_groups().values())
        self.num_actions = self._layout.num_dofs

    def observation_groups(self) -> dict[str, int]:
        """Return the ordered names and sizes of the observation parts."""
        return self.character_observation_groups()

    def character_observation_groups(self) -> dict[str, int]:
        """Return names and sizes of the parts of `compute_humanoid_observations`."""
        num_dofs, num_keys = self._layout.num_dofs, len(self.key_body_names())
        root = {"root_height": 1, "root_rot_tan_norm": 6, "root_lin_vel": 3, "root_ang_vel": 3}
        size = num_humanoid_obs(self._layout.dof_offsets, num_keys)
        joints = size - sum(root.values()) - num_dofs - 3 * num_keys
        return root | {"dof_pos": joints, "dof_vel": num_dofs, "key_body_pos": 3 * num_keys}

    def action_scaling(self) -> ActionScaling | None:
        """Return the mapping from actions to drive targets (rad), or to torques (Nm)."""
        unit = "rad" if self.env_cfg.pd_control else "Nm"
        return ActionScaling(unit, self._action_offset, self._action_scale)

    def robot_description(self) -> RobotDescription:
        """Return default pose, start, key bodies, and frames of the observation parts."""
        root_state, dof_pos = self.default_pose()
        default = RobotState(root_state, dof_pos, torch.zeros_like(dof_pos))
        return RobotDescription(default, default, self.key_body_names(), self.observation_frames())

    def observation_frames(self) -> dict[str, str]:
        """Return the frames of the observation parts."""
        vectors = ("root_lin_vel", "root_ang_vel", "key_body_pos")
        return {
            "root_height": "world",
            "root_rot_tan_norm": "heading" if self.env_cfg.local_root_obs else "world",
            **dict.fromkeys(vectors, "heading"),
            **dict.fromkeys(("dof_pos", "dof_vel"), "joint"),
        }

    def _pd_offset_scale(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        """Return offset and scale (D,) of PD targets for joint limits (D,), in rad."""
        return pd_action_offset_scale(lower, upper, self._layout.dof_offsets)

    def create_sim(self) -> None:
        """Create the simulations and look up bodies and limits."""
        self._check_asset()
        super().create_sim()
        self.dt = self.control_dt_s
        self.contact_body_ids = self._body_ids("contactBodies", self.contact_body_names())
        self.key_body_ids = self._body_ids("keyBodies", self.key_body_names())
        self.termination_heights_m = self._termination_heights()
        efforts = torch.tensor(self._model.actuator_forcerange[:, 1], dtype=torch.float32)
        self.motor_efforts = efforts.to(self.device)
        # The controls are offset + scale * action. Offset and scale are (D,).
        if self.env_cfg.pd_control:
            limits = torch.from_numpy(dof_limits(self._model, self._layout)).float()
            offset, scale = self._pd_offset_scale(limits[:, 0], limits[:, 1])
        else:
            offset, scale = torch.zeros_like(efforts), efforts * self.env_cfg.power_scale
        self._action_offset, self._action_scale = offset.to(self.device), scale.to(self.device)

    def _check_asset(self) -> None:
        num_dofs, num_actuators = self._layout.num_dofs, self._model.nu
        choices = self.num_dofs_of_assets or (num_dofs,)
        if num_dofs not in choices or num_actuators != num_dofs:
            expected = " or ".join(str(n) for n in choices)
            name = self.env_cfg.asset.asset_file_name or self.default_asset
            raise ConfigError(
                f"task.env.asset.assetFileName='{name}' has {num_dofs} degrees of freedom and"
                f" {num_actuators} actuators; {type(self).__name__} expects {expected} of both;"
                f" shipped: {shipped_assets()}"
            )

    def _termination_heights(self) -> float | Tensor:
        """Return the termination height (m) of all bodies, or one for each body (B,)."""
        return self.env_cfg.termination_height

    def _body_ids(self, key: str, names: tuple[str, ...]) -> Tensor:
        bodies = self.simulation.body_names
        for name in names:
            if name not in bodies:
                raise ConfigError(unknown(f"body in task.env.{key}:", name, bodies))
        ids = [bodies.index(name) for name in names]
        return torch.tensor(ids, dtype=torch.int64, device=self.device)

    def compute_controls(self, actions: Tensor) -> Tensor:
        """Return offset + scale * action (N, D), which are PD targets (rad) or torques (Nm)."""
        return torch.addcmul(self._action_offset, self._action_scale, actions)

    def compute_obs(self) -> Tensor:
        """Return the observations of all environments."""
        return self.compute_obs_of(None)

    @torch.inference_mode()
    def compute_obs_of(self, env_ids: Tensor | None) -> Tensor:
        """Return the observations of environments (n,) that start an episode, or of all."""
        return self._observe_character(env_ids)

    def _observe_character(self, env_ids: Tensor | None) -> Tensor:
        return compute_humanoid_observations(
            *self._character_states(env_ids),
            self.env_cfg.local_root_obs,
            dof_offsets=self._layout.dof_offsets,
        )

    def _character_states(self, env_ids: Tensor | None) -> CharacterState:
        sim = self.simulation
        # (3, K, N) is the memory order of the backend.
        key_body_pos = sim.body_pos.permute(2, 1, 0).index_select(1, self.key_body_ids)
        states = (sim.root_states, sim.dof_pos, sim.dof_vel, key_body_pos.permute(2, 1, 0))
        if env_ids is None:
            return states
        root_states, dof_pos, dof_vel, key_body_pos = (s.index_select(0, env_ids) for s in states)
        return root_states, dof_pos, dof_vel, key_body_pos

    def compute_reward_terms(self) -> Terms:
        """Return the constant task reward, without the style reward, which the agent adds."""
        return {"task": compute_humanoid_reward(self.obs_buf)}

    @torch.inference_mode()
    def compute_failures(self) -> Tensor:
        """Return which characters (N,) fell (see `compute_humanoid_falls`)."""
        if not self.env_cfg.enable_early_termination:
            return torch.zeros_like(self.timeout_buf)
        return compute_humanoid_falls(
            self.progress_buf,
            self.simulation.contact_forces,
            self.contact_body_ids,
            self.simulation.body_pos,
            self.termination_heights_m,
        )

    def infos(self) -> dict[str, Any]:
        """Return the number of divergences, and `terminate` (N,), which is 1 after a fall."""
        return {
            "terminate": (self.done_buf == Done.FAILED).long().to(self.rl_device),
            "diverged_simulations": self.simulation.num_failures,
        }

    def reset_state(self, env_ids: Tensor) -> None:
        """Put the humanoids into the default pose."""
        self._write_default_pose(env_ids)

    def _write_default_pose(self, env_ids: Tensor) -> None:
        root_state, dof_pos = self.default_pose()
        n = len(env_ids)
        self.simulation.write_state(
            env_ids,
            root_state.repeat(n, 1),
            dof_pos.repeat(n, 1),
            torch.zeros(n, self._layout.num_dofs, device=self.device),
        )

    def default_pose(self) -> tuple[Tensor, Tensor]:
        """Return root state (13,) and DOF positions (D,): upright, facing +x, all DOFs zero."""
        root_state = torch.zeros(13, device=self.device)
        root_state[2], root_state[6] = _START_HEIGHT_M, 1.0
        return root_state, torch.zeros(self._layout.num_dofs, device=self.device)
