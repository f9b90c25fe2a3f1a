"""HumanoidAMP: the humanoid that imitates motion clips, as IsaacGymEnvs' task of that name."""

from __future__ import annotations

import logging
import math
from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np
import torch
from torch import Tensor

from isaacgymenvs_lite.env_interface import TrackingDemo
from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.rendering.markers import Marker
from isaacgymenvs_lite.schema import read_section
from isaacgymenvs_lite.tasks.amp.clip_phases import ClipPhases
from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import (
    NUM_OBS,
    CharacterState,
    HumanoidAMPBase,
)
from isaacgymenvs_lite.tasks.amp.reference_motions import ClipStarts, ReferenceMotions
from isaacgymenvs_lite.tasks.base.humanoid_observations import (
    compute_humanoid_observations,
    num_humanoid_obs,
)
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.task_config import UNREAD_ENV_KEYS
from isaacgymenvs_lite.tasks.base.vec_task import Done, RobotState
from isaacgymenvs_lite.tasks.goals.boxes import damp_objects
from isaacgymenvs_lite.tasks.goals.goal import Goal

log = logging.getLogger(__name__)

NUM_AMP_OBS_PER_STEP = NUM_OBS  # of IsaacGymEnvs' humanoid, for scripts


def build_amp_observations(
    root_states: Tensor,
    dof_pos: Tensor,
    dof_vel: Tensor,
    key_body_pos: Tensor,
    local_root_obs: bool,
    as_ase: bool = False,
    dof_offsets: tuple[int, ...] | None = None,
) -> Tensor:
    """Return the AMP observation of one control step: (N, 105), or (N, 125) with `as_ase`.

    In IsaacGymEnvs it is the policy observation of the same state; see
    `compute_humanoid_observations` for arguments and layout.
    """
    return compute_humanoid_observations(
        root_states, dof_pos, dof_vel, key_body_pos, local_root_obs, as_ase, dof_offsets
    )


class HumanoidAMP(HumanoidAMPBase):
    """The humanoid with a motion library, AMP observations and resets into the reference motion.

    `ReferenceMotions` has the demonstrations, `ClipStarts` the starts of episodes, and `ClipPhases`
    follows episodes through their clips.

    The AMP observation holds `numAMPObsSteps` control steps, the newest first. The agent calls
    `reset_done` before each policy step, and reads `infos["amp_obs"]` (N, F) and
    `infos["terminate"]` (N,).

    Beside the style, a task that derives from it can reward a goal, which the last entries of the
    policy's observation describe.

    Args:
        cfg: cfg/task/HumanoidAMP.yaml as plain dictionaries; the rest as `VecTask`.

    Attributes:
        goal: what the character is rewarded for; none here.

    Raises:
        ConfigError: a key or value that cannot be used.
        MotionFileError: a clip that cannot be used.
    """

    not_stored = ("_off_clip",)
    # Joint positions of the AMP observation as ASE encodes them.
    amp_obs_as_ase: ClassVar[bool] = False
    goal_class: ClassVar[type[Goal]] = Goal
    """The goal, which reads its keys from `task.env`."""

    def read_settings(self, env: dict[str, Any]) -> Any:
        """Check `task.env`, and make the goal.

        Raises:
            ConfigError: an unknown, ill-typed or impossible value.
        """
        self.goal = self.goal_class(env)
        ignored = (*UNREAD_ENV_KEYS, *self.goal.keys())
        return read_section(self.settings_class, env, "task.env", ignored=ignored)

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Add the objects of the goal."""
        self.goal.add_to_model(spec)

    def observation_groups(self) -> dict[str, int]:
        """As the base; the goal comes last."""
        size = self.get_task_obs_size()
        return super().observation_groups() | ({self.goal.obs_name: size} if size else {})

    def get_task_obs_size(self) -> int:
        """Return how many of the last entries of an observation describe the goal."""
        return self.goal.num_task_obs

    def set_sizes(self) -> None:
        """As the base, and of one step of the AMP observation."""
        super().set_sizes()
        offsets, num_keys = self._layout.dof_offsets, len(self.key_body_names())
        self._num_amp_obs_per_step = num_humanoid_obs(offsets, num_keys, self.amp_obs_as_ase)

    def create_sim(self) -> None:
        """As the base, with objects that lose their velocities slowly; load the motions."""
        damp_objects(self._model, self._layout.object_names)
        super().create_sim()
        lib = MotionLib(
            self.env_cfg.motion_file,
            self.num_actions,
            self.key_body_ids.tolist(),
            self.device,
            repair_repeated_frames=self.env_cfg.repair_repeated_frames,
            skeleton=self.reference_skeleton(),
            interpolation=self.env_cfg.clip_interpolation,
            ground=self.env_cfg.ground_clips,
        )
        self._motions = ReferenceMotions(
            lib,
            self._amp_features,
            self.env_cfg.num_amp_obs_steps,
            self.control_dt_s,
            self.env_cfg.demo_motion_share,
        )
        own = self.contact_body_names()
        others = [body for body in lib.bodies_on_ground() if body not in own]
        if others and self.allows_contacts_of_clips:
            log.info("may touch the ground, as in the clips: %s", ", ".join(others))
            self.contact_body_ids = self._body_ids("contactBodies", (*own, *others))

    @property
    def allows_contacts_of_clips(self) -> bool:
        """Whether bodies that touch the ground in the clips may do so."""
        return self.env_cfg.contact_bodies is None

    def reference_skeleton(self) -> Skeleton | None:
        """Return the skeleton of the reference motions; None: of the shipped humanoid."""
        return None

    def allocate_buffers(self) -> None:
        """Add the AMP observation history, (N, numAMPObsSteps, ...), newest first."""
        super().allocate_buffers()
        self._amp_obs_buf = torch.zeros(
            self.num_envs,
            self.env_cfg.num_amp_obs_steps,
            self._num_amp_obs_per_step,
            device=self.device,
        )
        self._phases: ClipPhases | None = None
        # (N,) bool of this step; None: no clip is followed.
        self._off_clip: Tensor | None = None
        # Of the clip that episodes end with; None: they go on.
        self._ending: ClipPhases | None = None
        soon_limit = self.max_episode_length
        if self.env_cfg.clip_deviation > 0.0:
            standing_m = float(self.default_pose()[0][2])
            self._phases = ClipPhases.of_motions(
                self._motions, self.num_envs, self.control_dt_s, standing_m, self.env_cfg
            )
            self._end_with_clip(self._phases)
        self._starts = ClipStarts(
            self._motions,
            self.env_cfg,
            self.num_envs,
            self.control_dt_s,
            soon_limit,
            self.goal.look_ahead_s,
            ends_with_clip=self._ending is not None,
        )
        self.goal.attach(self.simulation, self.control_dt_s)

    def _end_with_clip(self, phases: ClipPhases) -> None:
        """Let episodes end with the only clip, if it does not return to where it starts."""
        starts_in_clip = self.env_cfg.state_init in ("Random", "Start")
        if not (
            self.env_cfg.end_with_clip and starts_in_clip and phases.repeats.tolist() == [False]
        ):
            return
        self._ending = phases
        length_s = float(self.motion_lib.get_motion_length([0]))
        slowness = 1.0 + (self.env_cfg.clip_tempo or 1.0)  # from the start, at the least tempo
        longest = math.ceil(slowness * length_s / self.control_dt_s) + 1
        self.max_episode_length = min(self.max_episode_length, longest)
        log.info(
            "the clip does not return to where it starts: episodes end with it, after at most"
            " %d control steps (task.env.endWithClip)",
            self.max_episode_length,
        )

    @property
    def clip_starts_s(self) -> Tensor | None:
        """Times (N,) s of the clip at which episodes started that end with it; None: none does."""
        return None if self._ending is None else self._starts.times_s

    def compute_time_outs(self) -> Tensor:
        """As the base, and where the clip that an episode ends with is over."""
        time_outs = super().compute_time_outs()
        return time_outs if self._ending is None else time_outs | self._ending.is_over

    @property
    def amp_observation_space(self) -> gymnasium.spaces.Box:
        """Box of one flattened AMP observation."""
        return gymnasium.spaces.Box(-np.inf, np.inf, (self.num_amp_obs,), np.float32)

    @property
    def num_amp_obs_steps(self) -> int:
        """Control steps in one AMP observation."""
        return self.env_cfg.num_amp_obs_steps

    @property
    def num_amp_obs(self) -> int:
        """Numbers in one flattened AMP observation, F."""
        return self.env_cfg.num_amp_obs_steps * self._num_amp_obs_per_step

    def _amp_features(self, state: CharacterState) -> Tensor:
        """AMP observations of one step of states as `_character_states` returns them."""
        return build_amp_observations(
            *state, self.env_cfg.local_root_obs, self.amp_obs_as_ase, self._layout.dof_offsets
        )

    def current_amp_features(self, env_ids: Tensor | None = None) -> Tensor:
        """Return one step of the AMP observation of all environments or `env_ids` (n,).

        To be called after `compute_observations`.
        """
        # It is the policy's observation of the same state, without the goal.
        features = self.obs_buf[:, : self._num_amp_obs_per_step]
        return features if env_ids is None else features.index_select(0, env_ids)

    def amp_obs_of(self, env_ids: Tensor) -> Tensor:
        """Return the AMP observations (n, F) of environments (n,), also after a reset."""
        rows = self._amp_obs_buf.index_select(0, env_ids.to(self.device))
        return rows.flatten(1).to(self.rl_device)

    @property
    def motion_lib(self) -> MotionLib:
        """The reference motions."""
        return self._motions.lib

    def keep_to_clips(self, env_ids: Tensor) -> None:
        """From here on, episodes (n,) that started in a clip fail if they leave it.

        To be called after a reset. Without `clipDeviation` it has no effect. With one clip the task
        itself calls it; with several the policy must receive which one is meant, as latents show.
        """
        if self._phases is None:
            return
        env_ids = env_ids.to(self.device)
        env_ids = env_ids[self._starts.clips[env_ids] >= 0]
        self._phases.start(env_ids, self._starts.clips[env_ids], self._starts.times_s[env_ids])

    def leave_clips(self, env_ids: Tensor) -> None:
        """From here on, episodes (n,) may do something else than their clips."""
        if self._phases is not None:
            self._phases.stop(env_ids.to(self.device))

    # --- a step ------------------------------------------------------------------------------

    def pre_physics_step(self, actions: Tensor) -> None:
        """As the base; the goal stores the state, and changes when its time is over."""
        super().pre_physics_step(actions)
        self.goal.before_step(self.progress_buf)

    def update_state(self) -> None:
        """Let the goal update what it remembers, and follow episodes through their clips."""
        self.goal.after_step()
        self._off_clip = None
        followed = self._phases if self.is_training else self._ending
        if followed is not None and followed.follows_any():
            self._off_clip = followed.are_off(self._character_states(None))

    @torch.inference_mode()
    def compute_obs_of(self, env_ids: Tensor | None) -> Tensor:
        """As the base, with the goals."""
        character = self._observe_character(env_ids)
        if self.goal.num_task_obs == 0:
            return character
        return torch.cat((character, self.goal.observe(env_ids)), dim=-1)

    def compute_reward_terms(self) -> Terms:
        """Return the goal's reward; the style reward is the agent's."""
        reward = self.goal.reward()
        return reward if isinstance(reward, dict) else {"task": reward}

    def goal_errors(self) -> dict[str, Tensor]:
        """Return how far the last step was from the goal, (N,) each; see `Goal.errors`."""
        return self.goal.errors()

    @property
    def key_help(self) -> str:
        """What the keys of a viewer do."""
        return self.goal.key_help

    def on_key(self, key: str) -> None:
        """Pass a key of a viewer to the goal."""
        self.goal.on_key(key)

    def markers(self, env_id: int) -> tuple[Marker, ...]:
        """Return what pictures of an environment show in addition to the character."""
        return self.goal.markers(env_id)

    @torch.inference_mode()
    def compute_failures(self) -> Tensor:
        """As the base, and where the goal was missed for good or the clip of the start was left."""
        fallen = super().compute_failures()
        if not self.env_cfg.enable_early_termination:
            return fallen
        if self._off_clip is not None and self.is_training:
            self.extras["off_clip"] = (self._off_clip & ~fallen).to(self.rl_device)
            fallen = fallen | self._off_clip
        missed = self.goal.failures(self.contact_body_ids)
        if missed is None:
            return fallen
        # Contact forces may be stale in the first step.
        return fallen | (missed & (self.progress_buf > 1))

    def post_physics_step(self) -> None:
        """As the base, then shift the AMP history and publish it, terminal states included."""
        super().post_physics_step()
        if self._starts.adaptive is not None:
            ended = (self.done_buf != Done.RUNNING) & (self._starts.clips >= 0)
            env_ids = ended.nonzero().flatten()
            failed = self.done_buf[env_ids] == Done.FAILED
            self._starts.count_ended(env_ids, self.progress_buf[env_ids], failed)
        newest, history = self.current_amp_features().unsqueeze(1), self._amp_obs_buf
        window = torch.cat((newest, history[:, :-1]), dim=1)
        history.copy_(window)
        self.extras["amp_obs"] = window.flatten(1).to(self.rl_device, non_blocking=True)

    # --- demonstrations ----------------------------------------------------------------------

    def fetch_amp_obs_demo(self, num_samples: int) -> Tensor:
        """Sample AMP observations of the reference motions.

        Clips are drawn by weight; the last instant is drawn so that the whole history lies inside
        the clip, as in ASE (IsaacGymEnvs extrapolates before the start).

        Args:
            num_samples: n, any number.

        Returns:
            (n, F) on rl_device, laid out as `infos["amp_obs"]`.
        """
        return self._motions.windows(*self._motions.draw_windows(num_samples)).to(self.rl_device)

    def fetch_amp_obs_demo_pairs(self, num_samples: int, apart_s: float = 1.0) -> Tensor:
        """Sample pairs of AMP observations of one motion, near each other.

        Args:
            num_samples: n, any number.
            apart_s: s, at most so far apart; a clip's start and end limit it further.

        Returns:
            (n, 2, F) on rl_device, the first of each pair as `fetch_amp_obs_demo`.
        """
        return self._motions.draw_pairs(num_samples, apart_s).to(self.rl_device)

    def fetch_tracking_demo(self, num_samples: int, with_goal: bool = True) -> TrackingDemo | None:
        """Sample moments of the clips, and actions that go on with them.

        A drive with target q + kd / kp * v has no force at position q and velocity v. The targets
        are of the next control step, so that the drives lead.

        To be called before a reset of all environments, whose states it may replace.

        Args:
            num_samples: n, any number.
            with_goal: the observations end with the goal.

        Returns:
            Tensors on rl_device; None if the policy observes what clips do not show, or acts by
            torques.
        """
        if not self.env_cfg.pd_control:
            return None
        motions, dt_s = self._motions, self.control_dt_s
        motion_ids = motions.lib.sample_motions(num_samples)
        times = motions.lib.sample_time(motion_ids, truncate_time=3 * dt_s)
        later = -torch.tensor([0.0, 1.0, 3.0], device=self.device)
        states = motions.states(motion_ids, times, later)
        root, dof_pos, dof_vel, key_pos = (part[:num_samples] for part in states)
        obs = self._observe_clip((root, dof_pos, dof_vel, key_pos))
        if obs is None:
            return None
        if with_goal and self.goal.num_task_obs > 0:
            roots_ahead = motions.roots_ahead(motion_ids, times, self.goal.look_ahead_s)
            goal = self.goal.observe_clip(roots_ahead)
            if goal is None:
                return None
            obs = torch.cat((obs, goal), dim=-1)
        _, near, far = states[1].view(3, num_samples, -1)
        # Exponential maps jump by a whole turn.
        change = torch.remainder(far - near + torch.pi, 2 * torch.pi) - torch.pi
        kp, kd = -torch.from_numpy(self._model.actuator_biasprm[:, 1:3]).float().t()
        leads_s = torch.where(kp > 0, kd / kp.clamp(min=1e-9), 0.0).to(self.device)
        targets = near + leads_s * change / (2 * dt_s)
        actions = ((targets - self._action_offset) / self._action_scale).clamp(-1.0, 1.0)
        amp_obs = motions.windows(motion_ids, times)
        return TrackingDemo(*(rows.to(self.rl_device) for rows in (obs, actions, amp_obs)))

    def _observe_clip(self, states: CharacterState) -> Tensor | None:
        """Return what is observed of characters in states of clips; None: clips do not show it."""
        return self._amp_features(states)

    def windows_of_clips(self) -> list[Tensor]:
        """Return the AMP observations (W, F) of each clip, one for each control step."""
        return [windows.to(self.rl_device) for windows in self._motions.windows_of_clips()]

    # --- reset -------------------------------------------------------------------------------

    def reset_state(self, env_ids: Tensor) -> None:
        """Start each environment as `stateInit` names, in the default pose or at a time of a clip.

        Draws goals, which the first observation contains.
        """
        mode = self.env_cfg.state_init
        reference_ids, default_ids = env_ids, env_ids[:0]
        if mode == "Default":
            reference_ids, default_ids = default_ids, reference_ids
        elif mode == "Hybrid":
            from_clip = torch.rand(len(env_ids), device=self.device) < self.env_cfg.hybrid_init_prob
            reference_ids, default_ids = env_ids[from_clip], env_ids[~from_clip]
        self._reference_env_ids = reference_ids
        if len(reference_ids) > 0:
            starts = self._starts.next(reference_ids)
            root_states, dof_pos, dof_vel, self._reference_history, self._roots_ahead = starts
            if self.motion_lib.num_motions() == 1:  # between clips a policy may change
                self.keep_to_clips(reference_ids)
            self.simulation.write_state(reference_ids, root_states, dof_pos, dof_vel)
        if len(default_ids) > 0:
            self._write_default_pose(default_ids)
        self.goal.reset(env_ids)
        if len(reference_ids) > 0:
            self.goal.start_in_clip(reference_ids, self._roots_ahead)

    def first_start(self) -> RobotState | None:
        """Return the start of the first clip, unless episodes start in the default pose."""
        if self.env_cfg.state_init == "Default":
            return None
        first = torch.zeros(1, dtype=torch.int64, device=self.device)
        states = self._motions.states(first, first.float(), first)
        root_state, dof_pos, dof_vel = (rows[0] for rows in states[:3])
        return RobotState(root_state, dof_pos, dof_vel)

    def reset(self) -> dict[str, Tensor]:
        """As the base; starts that were drawn before are dropped, for the seed's sake."""
        self._starts.clear()
        return super().reset()

    def reset_idx(self, env_ids: Tensor) -> None:
        """As the base, and fill the AMP history with the steps before the start."""
        self._starts.clips[env_ids] = -1
        self.leave_clips(env_ids)
        super().reset_idx(env_ids)
        self._start_histories(env_ids)

    @torch.inference_mode()
    def _start_histories(self, env_ids: Tensor) -> None:
        now = self.current_amp_features(env_ids)
        # Without a reference motion: as if the character had been standing still.
        standing = now.unsqueeze(1).expand(-1, self.env_cfg.num_amp_obs_steps, -1)
        self._amp_obs_buf.index_copy_(0, env_ids, standing)
        if len(self._reference_env_ids) > 0:
            before = self._amp_obs_buf[:, 1:]
            before.index_copy_(0, self._reference_env_ids, self._reference_history)
