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
from isaacgymenvs_lite.tasks.amp.adaptive_starts import AdaptiveStarts
from isaacgymenvs_lite.tasks.amp.clip_phases import PHASES_PER_STEP, ClipPhases
from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import (
    NUM_OBS,
    CharacterState,
    HumanoidAMPBase,
)
from isaacgymenvs_lite.tasks.amp.prefetched_sampler import PrefetchedSampler
from isaacgymenvs_lite.tasks.base.history import push_newest
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
_STARTS_AT_A_TIME = 1024
# Windows of clips computed at a time: many more leave the CPU's cache and take twice as long.
_WINDOWS_AT_A_TIME = 256
# A failure in this time is one of the start: about as long as a leap with its landing.
_FAILS_SOON_S = 1.5
# An episode that ends with its clip lasts at least so long.
_LEAST_LEFT_S = 0.5


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


def _points(state: CharacterState) -> Tensor:
    """Return the root and the key bodies, (n, 1 + K, 3) m, from the root's place on the ground."""
    root_pos = state[0][:, None, :3]
    return torch.cat((root_pos, state[3]), dim=1) - root_pos * root_pos.new_tensor([1, 1, 0])


class HumanoidAMP(HumanoidAMPBase):
    """The humanoid with a motion library, AMP observations and resets into the reference motion.

    The AMP observation holds `numAMPObsSteps` control steps, the newest first. The agent calls
    `reset_done` before each policy step, so that `step` returns the terminal observation, and reads
    `infos["amp_obs"]` (N, F) and `infos["terminate"]` (N,).

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

    not_stored = ("_motion_lib", "_off_clip")
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

    def create_sim(self) -> None:
        """As the base, with objects that lose their velocities slowly; load the motions."""
        damp_objects(self._model, self._layout.object_names)
        super().create_sim()
        self._motion_lib = MotionLib(
            self.env_cfg.motion_file,
            self.num_actions,
            self.key_body_ids.tolist(),
            self.device,
            repair_repeated_frames=self.env_cfg.repair_repeated_frames,
            skeleton=self.reference_skeleton(),
            interpolation=self.env_cfg.clip_interpolation,
            ground=self.env_cfg.ground_clips,
        )
        if self.allows_contacts_of_clips:
            self._allow_contacts_of_clips()

    @property
    def allows_contacts_of_clips(self) -> bool:
        """Whether bodies that touch the ground in the clips may do so."""
        return self.env_cfg.contact_bodies is None

    def _allow_contacts_of_clips(self) -> None:
        own = self.contact_body_names()
        others = [body for body in self._motion_lib.bodies_on_ground() if body not in own]
        if others:
            log.info("may touch the ground, as in the clips: %s", ", ".join(others))
            self.contact_body_ids = self._body_ids("contactBodies", (*own, *others))

    def reference_skeleton(self) -> Skeleton | None:
        """Return the skeleton of the reference motions; None: of the shipped humanoid."""
        return None

    def allocate_buffers(self) -> None:
        """Add the AMP observation history, (N, numAMPObsSteps, ...), newest first."""
        super().allocate_buffers()
        self._amp_obs_buf = torch.zeros(
            self.num_envs,
            self.env_cfg.num_amp_obs_steps,
            self._num_amp_obs_per_step(),
            device=self.device,
        )
        self._starts = PrefetchedSampler(
            self._draw_starts, block=min(self.num_envs, _STARTS_AT_A_TIME)
        )
        self._adaptive: AdaptiveStarts | None = None
        if self.env_cfg.adaptive_starts > 0.0:
            lib, soon_steps = self._motion_lib, round(_FAILS_SOON_S / self.control_dt_s)
            self._adaptive = AdaptiveStarts(
                lib.get_motion_length(range(lib.num_motions())),
                lib.motion_weights(),
                min(soon_steps, self.max_episode_length // 2),
            )
        # Clips in which the episodes started, -1: in the default pose; and when in them.
        self._start_clips = torch.full_like(self.progress_buf, -1)
        self._start_times_s = torch.zeros(self.num_envs, device=self.device)
        self._phases = self._make_phases() if self.env_cfg.clip_deviation > 0.0 else None
        # (N,) bool of this step; None: no clip is followed.
        self._off_clip: Tensor | None = None
        # Of the clip that episodes end with; None: they go on.
        self._ending: ClipPhases | None = None
        if self._phases is not None and self._may_end_with_clip(self._phases):
            self._ending = self._phases
            self.max_episode_length = min(self.max_episode_length, self._longest_way_through())
            log.info(
                "the clip does not return to where it starts: episodes end with it, after at most"
                " %d control steps (task.env.endWithClip)",
                self.max_episode_length,
            )
        self.goal.attach(self.simulation, self.control_dt_s)

    def _may_end_with_clip(self, phases: ClipPhases) -> bool:
        starts_in_clip = self.env_cfg.state_init in ("Random", "Start")
        return self.env_cfg.end_with_clip and starts_in_clip and phases.repeats.tolist() == [False]

    def _longest_way_through(self) -> int:
        """Return the control steps from the start of the clip to its end, at the least tempo."""
        length_s = float(self._motion_lib.get_motion_length([0]))
        slowness = 1.0 + (self.env_cfg.clip_tempo or 1.0)
        return math.ceil(slowness * length_s / self.control_dt_s) + 1

    @property
    def clip_starts_s(self) -> Tensor | None:
        """Times (N,) s of the clip at which episodes started that end with it; None: none does."""
        return None if self._ending is None else self._start_times_s

    def compute_time_outs(self) -> Tensor:
        """As the base, and where the clip that an episode ends with is over."""
        time_outs = super().compute_time_outs()
        return time_outs if self._ending is None else time_outs | self._ending.are_over()

    def _make_phases(self) -> ClipPhases:
        """Return what follows episodes through the clips that they started in."""
        clips, root_states = [], []
        for motion_id in range(self._motion_lib.num_motions()):
            length_s = float(self._motion_lib.get_motion_length([motion_id]))
            times_s = torch.arange(
                0.0, length_s, self.control_dt_s / PHASES_PER_STEP, device=self.device
            )
            ids = torch.full((len(times_s),), motion_id, device=self.device)
            state = self._reference_states(ids, times_s, ids.new_zeros(1))
            clips.append(_points(state))
            root_states.append(state[0])
        height_m = float(self.default_pose()[0][2])
        limit_m = self.env_cfg.clip_deviation * height_m
        final_limit_m = self.env_cfg.clip_deviation_final * height_m or limit_m
        return ClipPhases(
            clips,
            self.num_envs,
            self.control_dt_s,
            limit_m,
            root_states,
            self.env_cfg.clip_travel,
            self.env_cfg.clip_tempo,
            min(limit_m, final_limit_m),
        )

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
        return self.env_cfg.num_amp_obs_steps * self._num_amp_obs_per_step()

    def _num_amp_obs_per_step(self) -> int:
        offsets = self._layout.dof_offsets
        return num_humanoid_obs(offsets, len(self.key_body_names()), self.amp_obs_as_ase)

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
        features = self.obs_buf[:, : self._num_amp_obs_per_step()]
        return features if env_ids is None else features.index_select(0, env_ids)

    def amp_obs_of(self, env_ids: Tensor) -> Tensor:
        """Return the AMP observations (n, F) of environments (n,), also after a reset."""
        rows = self._amp_obs_buf.index_select(0, env_ids.to(self.device))
        return rows.flatten(1).to(self.rl_device)

    @property
    def motion_lib(self) -> MotionLib:
        """The reference motions."""
        return self._motion_lib

    def keep_to_clips(self, env_ids: Tensor) -> None:
        """From here on, episodes (n,) that started in a clip fail if they leave it.

        To be called after a reset. Without `clipDeviation` it has no effect. With one clip the task
        itself calls it; with several the policy must receive which one is meant, as latents show.
        """
        if self._phases is None:
            return
        env_ids = env_ids.to(self.device)
        env_ids = env_ids[self._start_clips[env_ids] >= 0]
        clips, times_s = self._start_clips[env_ids], self._start_times_s[env_ids]
        self._phases.start(env_ids, clips, times_s)

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
            self._off_clip = self._are_off_clip(followed)

    def _observe(self, env_ids: Tensor | None) -> Tensor:
        """Return the observations of all environments, or of `env_ids` (n,), with their goals."""
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

    @torch.inference_mode()
    def _are_off_clip(self, phases: ClipPhases) -> Tensor:
        """Move the phases on by a control step; return (N,) bool: who left its clip."""
        state = self._character_states(None)
        is_far = phases.advance(_points(state)) > phases.current_limit_m()
        is_behind = phases.lags_behind(state[0][:, :3], state[0][:, 3:7])
        return is_far | is_behind | phases.is_off_tempo()

    def post_physics_step(self) -> None:
        """As the base, then shift the AMP history and publish it, terminal states included."""
        super().post_physics_step()
        self._count_starts()
        history = self._amp_obs_buf
        push_newest(history, self.current_amp_features())
        self.extras["amp_obs"] = self._for_trainer(history.flatten(1))

    def _count_starts(self) -> None:
        """Count the episodes that end in this step by where they started."""
        if self._adaptive is None:
            return
        ended = ((self.done_buf != Done.RUNNING) & (self._start_clips >= 0)).nonzero().flatten()
        if len(ended) > 0:
            failed = self.done_buf[ended] == Done.FAILED
            bins = self._adaptive.bins_of(self._start_clips[ended], self._start_times_s[ended])
            self._adaptive.count(bins, self.progress_buf[ended], failed)

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
        return self._windows_at(*self._draw_windows(num_samples))

    def fetch_amp_obs_demo_pairs(self, num_samples: int, apart_s: float = 1.0) -> Tensor:
        """Sample pairs of AMP observations of one motion, near each other.

        Args:
            num_samples: n, any number.
            apart_s: s, at most so far apart; a clip's start and end limit it further.

        Returns:
            (n, 2, F) on rl_device, the first of each pair as `fetch_amp_obs_demo`.
        """
        motion_ids, times = self._draw_windows(num_samples)
        shift_s = apart_s * (2.0 * torch.rand(num_samples, device=self.device) - 1.0)
        last_s = self._motion_lib.get_motion_length(motion_ids).to(times)
        # Of a clip shorter than the history the window is always the same.
        earliest_s = torch.full_like(times, self._history_s)
        others = torch.maximum(torch.minimum(times + shift_s, last_s), earliest_s)
        first, second = (self._windows_at(motion_ids, at) for at in (times, others))
        return torch.stack((first, second), dim=1)

    @property
    def _history_s(self) -> float:
        """Time in s from the oldest to the newest control step of an AMP observation."""
        return self.control_dt_s * (self.env_cfg.num_amp_obs_steps - 1)

    def _draw_windows(self, n: int) -> tuple[Tensor, Tensor]:
        """Draw motions (n,) by weight, and the last instants (n,) s of windows inside them."""
        lib, history_s = self._motion_lib, self._history_s
        motion_ids = lib.sample_motions(n)
        times = lib.sample_time(motion_ids, truncate_time=history_s) + history_s
        share = self.env_cfg.demo_motion_share
        if share > 0.0:
            is_by_motion = torch.rand(n, device=self.device) < share
            by_motion = lib.sample_moving_time(motion_ids).clamp(min=history_s)
            times = torch.where(is_by_motion, by_motion, times)
        return motion_ids, times

    def _windows_at(self, motion_ids: Tensor, times: Tensor) -> Tensor:
        """Return AMP observations (n, F) on rl_device of windows that end at times (n,) s."""
        steps = torch.arange(self.env_cfg.num_amp_obs_steps, device=self.device)
        windows = [
            self._reference_features(ids, at_s, steps).flatten(1)
            for ids, at_s in zip(
                motion_ids.split(_WINDOWS_AT_A_TIME), times.split(_WINDOWS_AT_A_TIME), strict=True
            )
        ]
        return torch.cat(windows).to(self.rl_device)

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
        lib, dt_s = self._motion_lib, self.control_dt_s
        motion_ids = lib.sample_motions(num_samples)
        times = lib.sample_time(motion_ids, truncate_time=3 * dt_s)
        later = -torch.tensor([0.0, 1.0, 3.0], device=self.device)
        states = self._reference_states(motion_ids, times, later)
        root, dof_pos, dof_vel, key_pos = (part[:num_samples] for part in states)
        obs = self._observe_clip((root, dof_pos, dof_vel, key_pos))
        if obs is None:
            return None
        if with_goal and self.goal.num_task_obs > 0:
            goal = self.goal.observe_clip(self._roots_ahead_of(motion_ids, times))
            if goal is None:
                return None
            obs = torch.cat((obs, goal), dim=-1)
        _, near, far = states[1].view(3, num_samples, -1)
        # Exponential maps jump by a whole turn.
        change = torch.remainder(far - near + torch.pi, 2 * torch.pi) - torch.pi
        targets = near + self._leads_s() * change / (2 * dt_s)
        actions = ((targets - self._action_offset) / self._action_scale).clamp(-1.0, 1.0)
        amp_obs = self._windows_at(motion_ids, times)
        return TrackingDemo(obs.to(self.rl_device), actions.to(self.rl_device), amp_obs)

    def _observe_clip(self, states: CharacterState) -> Tensor | None:
        """Return what is observed of characters in states of clips; None: clips do not show it."""
        return self._observe_states(states)

    def _leads_s(self) -> Tensor:
        """Return kd / kp (D,) s of the drives."""
        kp, kd = -torch.from_numpy(self._model.actuator_biasprm[:, 1:3]).float().t()
        return torch.where(kp > 0, kd / kp.clamp(min=1e-9), 0.0).to(self.device)

    def windows_of_clips(self) -> list[Tensor]:
        """Return the AMP observations (W, F) of each clip, one for each control step.

        As `fetch_amp_obs_demo`, but all of them; a clip shorter than the history gives one.
        """
        windows = []
        for motion_id in range(self._motion_lib.num_motions()):
            left_s = float(self._motion_lib.get_motion_length([motion_id])) - self._history_s
            count = 1 + max(0, int(left_s / self.control_dt_s))
            times = self._history_s + self.control_dt_s * torch.arange(count, device=self.device)
            ids = torch.full((count,), motion_id, device=self.device)
            windows.append(self._windows_at(ids, times))
        return windows

    def _reference_features(self, motion_ids: Tensor, times: Tensor, steps: Tensor) -> Tensor:
        """AMP features (n, len(steps), ...) of motions (n,) at times (n,) s, `steps` earlier."""
        features = self._amp_features(self._reference_states(motion_ids, times, steps))
        return features.view(len(steps), len(motion_ids), -1).transpose(0, 1)

    def _reference_states(self, motion_ids: Tensor, times: Tensor, steps: Tensor) -> CharacterState:
        """States of motions (n,) at times (n,) s, `steps` (s,) earlier: s * n, step by step.

        Root states (..., 13), DOF positions and velocities (..., D), key bodies (..., K, 3).
        """
        ids = motion_ids.repeat(len(steps))
        at_s = (times - self.control_dt_s * steps.unsqueeze(1)).flatten()
        root_pos, root_rot, dof_pos, root_vel, root_ang_vel, dof_vel, key_pos = (
            self._motion_lib.get_motion_state(ids, at_s)
        )
        root_states = torch.cat((root_pos, root_rot, root_vel, root_ang_vel), dim=-1)
        return root_states, dof_pos, dof_vel, key_pos

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
        self._reset_to_reference(reference_ids)
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
        states = self._reference_states(first, first.float(), first)
        root_state, dof_pos, dof_vel = (rows[0] for rows in states[:3])
        return RobotState(root_state, dof_pos, dof_vel)

    def reset(self) -> dict[str, Tensor]:
        """As the base; starts that were drawn before are dropped, for the seed's sake."""
        self._starts.clear()
        return super().reset()

    @torch.inference_mode()
    def _draw_starts(self, n: int) -> tuple[Tensor, ...]:
        """Draw moments of the clips: their states, and what is before and after them.

        Root states (n, 13), DOF positions and velocities (n, D), the AMP features of the steps
        before (n, steps - 1, ...), the root states that the goal looks ahead (n, T, 13), and the
        clips (n,) and times (n,) s.
        """
        motion_ids, times = self._draw_moments(n)
        steps = torch.arange(self.env_cfg.num_amp_obs_steps, device=self.device)
        root, dof_pos, dof_vel, key_pos = self._reference_states(motion_ids, times, steps)
        before = self._amp_features((root[n:], dof_pos[n:], dof_vel[n:], key_pos[n:]))
        history = before.view(len(steps) - 1, n, -1).transpose(0, 1)
        ahead = self._roots_ahead_of(motion_ids, times)
        return root[:n], dof_pos[:n], dof_vel[:n], history, ahead, motion_ids, times

    def _draw_moments(self, n: int) -> tuple[Tensor, Tensor]:
        """Draw motions (n,) and times (n,) s in them at which episodes start."""
        lib = self._motion_lib
        motion_ids = lib.sample_motions(n)
        if self.env_cfg.state_init == "Start":
            return motion_ids, torch.zeros(n, device=self.device)
        least_left_s = None if self._ending is None else _LEAST_LEFT_S
        times = lib.sample_time(motion_ids, truncate_time=least_left_s)
        if self._adaptive is not None:
            is_adaptive = torch.rand(n, device=self.device) < self.env_cfg.adaptive_starts
            hard_ids, hard_times = self._adaptive.draw(n)
            motion_ids = torch.where(is_adaptive, hard_ids, motion_ids)
            times = torch.where(is_adaptive, hard_times, times)
        return motion_ids, times

    def _roots_ahead_of(self, motion_ids: Tensor, times: Tensor) -> Tensor:
        """Return the root states (n, T, 13) that the goal looks ahead from times (n,) s on."""
        ahead_s, n = self.goal.look_ahead_s, len(motion_ids)
        if not ahead_s:
            return torch.zeros(n, 0, 13, device=self.device)
        later = -torch.tensor(ahead_s, device=self.device) / self.control_dt_s
        roots = self._reference_states(motion_ids, times, later)[0]
        return roots.view(len(ahead_s), n, 13).transpose(0, 1)

    def _reset_to_reference(self, env_ids: Tensor) -> None:
        """Put environments into states of sampled clips, and keep the steps before it."""
        self._reference_env_ids = env_ids
        if len(env_ids) == 0:
            return
        *starts, clips, times_s = self._starts.next(len(env_ids))
        root_states, dof_pos, dof_vel, self._reference_history, self._roots_ahead = starts
        self._start_clips[env_ids] = clips
        self._start_times_s[env_ids] = times_s
        if self._motion_lib.num_motions() == 1:  # between clips a policy may change
            self.keep_to_clips(env_ids)
        self.simulation.write_state(env_ids, root_states, dof_pos, dof_vel)

    def reset_idx(self, env_ids: Tensor) -> None:
        """As the base, and fill the AMP history with the steps before the start."""
        self._start_clips[env_ids] = -1
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
