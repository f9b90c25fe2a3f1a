"""HumanoidAMP: the humanoid imitates motion clips, as in IsaacGymEnvs."""

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
from isaacgymenvs_lite.tasks.base.vec_task import Done, RobotDescription, RobotState
from isaacgymenvs_lite.tasks.goals.boxes import damp_objects
from isaacgymenvs_lite.tasks.goals.goal import ClipsAhead, Goal

log = logging.getLogger(__name__)

NUM_AMP_OBS_PER_STEP = NUM_OBS  # scripts for IsaacGymEnvs' humanoid use this name


build_amp_observations = compute_humanoid_observations
"""One step of the AMP observation equals the policy observation of the same state."""


class HumanoidAMP(HumanoidAMPBase):
    """The humanoid with clips, which provide demonstrations and the starts of episodes.

    `ReferenceMotions` provides the demonstrations, and `ClipStarts` provides the starts of
    episodes. `ClipPhases` compares episodes with their clips.

    The AMP observation contains `numAMPObsSteps` control steps, newest first. The agent calls
    `reset_done` before each policy step, and reads `infos["amp_obs"]` (N, F) and
    `infos["terminate"]` (N,).

    A derived task can add a goal, which is rewarded in addition to the motion style. The last
    entries of the policy observation describe the goal.

    Attributes:
        goal: the goal, which has no reward and no observation in HumanoidAMP.

    Raises:
        ConfigError: a setting is invalid.
        MotionFileError: a clip is invalid.
    """

    not_stored = ("_off_clip",)
    amp_obs_as_ase: ClassVar[bool] = False  # see `dof_to_obs`
    goal_class: ClassVar[type[Goal]] = Goal
    """Class of the goal. A goal reads its keys of `task.env`."""

    def read_settings(self, env: dict[str, Any]) -> Any:
        """Check `task.env` and create the goal."""
        self.goal = self.goal_class(env)
        ignored = (*UNREAD_ENV_KEYS, *self.goal.keys())
        return read_section(self.settings_class, env, "task.env", ignored=ignored)

    def change_spec(self, spec: mujoco.MjSpec) -> None:
        """Add the objects of the goal."""
        self.goal.add_to_model(spec)

    def observation_groups(self) -> dict[str, int]:
        """Return names and sizes of the observation parts, of which the goal is the last."""
        size = self.get_task_obs_size()
        return super().observation_groups() | ({self.goal.obs_name: size} if size else {})

    def get_task_obs_size(self) -> int:
        """Return how many of the last entries of an observation describe the goal."""
        return self.goal.num_task_obs

    def set_sizes(self) -> None:
        """Set the sizes of observations, actions and AMP observations."""
        super().set_sizes()
        offsets, num_keys = self._layout.dof_offsets, len(self.key_body_names())
        self._num_amp_obs_per_step = num_humanoid_obs(offsets, num_keys, self.amp_obs_as_ase)

    def create_sim(self) -> None:
        """Create the simulations, damp the goal's objects, and load the clips."""
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
            log.info("bodies that touch the ground in the clips may do so: %s", ", ".join(others))
            self.contact_body_ids = self._body_ids("contactBodies", (*own, *others))

    @property
    def allows_contacts_of_clips(self) -> bool:
        """Whether bodies that touch the ground in the clips may touch it in episodes."""
        return self.env_cfg.contact_bodies is None

    def reference_skeleton(self) -> Skeleton | None:
        """Return the skeleton of the clips. None selects the shipped humanoid."""
        return None

    def allocate_buffers(self) -> None:
        """Add the AMP observation history, the clip phases and the starts of episodes."""
        super().allocate_buffers()
        size = (self.num_envs, self.num_amp_obs_steps, self._num_amp_obs_per_step)
        self._amp_obs_buf = torch.zeros(size, device=self.device)  # newest first
        self._phases: ClipPhases | None = None
        # Marks characters (N,) that left their clips, or is None without a comparison.
        self._off_clip: Tensor | None = None
        # The phases of the clip whose end also ends episodes, or None.
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
        self.goal.key_bodies = self.key_body_names()
        self.goal.attach(self.simulation, self.control_dt_s)

    def _end_with_clip(self, phases: ClipPhases) -> None:
        """Let episodes end with the only clip, unless this clip returns to its start."""
        cfg = self.env_cfg
        starts_in_clip = cfg.state_init in ("Random", "Start")
        if not (cfg.end_with_clip and starts_in_clip and phases.repeats.tolist() == [False]):
            return
        self._ending = phases
        length_s = float(self.motion_lib.get_motion_length([0]))
        slowness = 1.0 + (cfg.clip_tempo or 1.0)
        longest = math.ceil(slowness * length_s / self.control_dt_s) + 1
        self.max_episode_length = min(self.max_episode_length, longest)
        log.info(
            "the clip does not return to its start, so episodes end with it, after at most %d"
            " control steps (task.env.endWithClip)",
            self.max_episode_length,
        )

    @property
    def clip_starts_s(self) -> Tensor | None:
        """Start times (N,) s of episodes in the clip that ends them, or None if no clip does."""
        return None if self._ending is None else self._starts.times_s

    def compute_time_outs(self) -> Tensor:
        """Return which episodes (N,) end, but not by a failure.

        They reached the time limit or the end of the clip, or a goal forgives in training that it
        cannot be reached any more.
        """
        time_outs = super().compute_time_outs()
        if self._ending is not None:
            time_outs = time_outs | self._ending.is_over
        if self._forgives_failures and (missed := self._missed_goals()) is not None:
            time_outs = time_outs | missed
        return time_outs

    @property
    def _forgives_failures(self) -> bool:
        return self.is_training and self.goal.forgives_failures

    def _missed_goals(self) -> Tensor | None:
        """Return which goals (N,) cannot be reached any more, or None if goals always can."""
        if not self.env_cfg.enable_early_termination:
            return None
        missed = self.goal.failures(self.contact_body_ids)
        # The contact forces of an episode's first step may be stale.
        return None if missed is None else missed & (self.progress_buf > 1)

    @property
    def amp_observation_space(self) -> gymnasium.spaces.Box:
        """Box of one flattened AMP observation."""
        return gymnasium.spaces.Box(-np.inf, np.inf, (self.num_amp_obs,), np.float32)

    @property
    def num_amp_obs_steps(self) -> int:
        """Number of control steps in an AMP observation."""
        return self.env_cfg.num_amp_obs_steps

    @property
    def num_amp_obs(self) -> int:
        """Dimension F of a flattened AMP observation."""
        return self.env_cfg.num_amp_obs_steps * self._num_amp_obs_per_step

    def _amp_features(self, state: CharacterState) -> Tensor:
        return build_amp_observations(
            *state, self.env_cfg.local_root_obs, self.amp_obs_as_ase, self._layout.dof_offsets
        )

    def current_amp_features(self, env_ids: Tensor | None = None) -> Tensor:
        """Return one step of the AMP observations of `env_ids` (n,). None selects all environments.

        Call `compute_observations` first.
        """
        # The policy observation starts with one step of the AMP observation.
        features = self.obs_buf[:, : self._num_amp_obs_per_step]
        return features if env_ids is None else features.index_select(0, env_ids)

    def amp_obs_of(self, env_ids: Tensor) -> Tensor:
        """Return the current AMP observations (n, F) of environments (n,)."""
        rows = self._amp_obs_buf.index_select(0, env_ids.to(self.device))
        return rows.flatten(1).to(self.rl_device)

    @property
    def motion_lib(self) -> MotionLib:
        """The clips."""
        return self._motions.lib

    def keep_to_clips(self, env_ids: Tensor) -> None:
        """From now on, let episodes (n,) that started in a clip fail if they leave it.

        Call this method after a reset. It has no effect without `clipDeviation`. If there is only
        one clip, the task calls the method itself. If there are several clips, the policy must
        observe which clip to follow, for example by a latent vector.
        """
        if self._phases is None:
            return
        env_ids = env_ids.to(self.device)
        env_ids = env_ids[self._starts.clips[env_ids] >= 0]
        self._phases.start(env_ids, self._starts.clips[env_ids], self._starts.times_s[env_ids])

    def leave_clips(self, env_ids: Tensor) -> None:
        """Stop comparing episodes (n,) with clips, so that leaving a clip does not end them."""
        if self._phases is not None:
            self._phases.stop(env_ids.to(self.device))

    # --- a step ------------------------------------------------------------------------------

    def pre_physics_step(self, actions: Tensor) -> None:
        """Run the base method, then let the goal prepare the step."""
        super().pre_physics_step(actions)
        self.goal.before_step(self.progress_buf)

    def update_state(self) -> None:
        """Update the goal, and compare the characters with the clips that they started in."""
        self.goal.after_step()
        self._off_clip = None
        followed = self._phases if self.is_training else self._ending
        if followed is not None and followed.follows_any():
            self._off_clip = followed.are_off(self._character_states(None))

    @torch.inference_mode()
    def compute_obs_of(self, env_ids: Tensor | None) -> Tensor:
        """Return observations, including the goal, of environments (n,) or of all."""
        character = self._observe_character(env_ids)
        if self.goal.num_task_obs == 0:
            return character
        return torch.cat((character, self.goal.observe(env_ids)), dim=-1)

    def compute_reward_terms(self) -> Terms:
        """Return the reward terms of the goal, without the style reward, which the agent adds."""
        reward = self.goal.reward()
        return reward if isinstance(reward, dict) else {"task": reward}

    def goal_errors(self) -> dict[str, Tensor]:
        """Return the errors (N,) of the last step relative to the goal (see `Goal.errors`)."""
        return self.goal.errors()

    def episode_successes(self) -> dict[str, Tensor]:
        """Return the successes (N,) of the goal (see `Goal.successes`)."""
        return self.goal.successes()

    @property
    def key_help(self) -> str:
        """Help text about the goal's keys."""
        return self.goal.key_help

    def on_key(self, key: str) -> None:
        """Pass a key press to the goal."""
        self.goal.on_key(key)

    def markers(self, env_id: int) -> tuple[Marker, ...]:
        """Return the markers that picture the goal of one environment."""
        return self.goal.markers(env_id)

    @torch.inference_mode()
    def compute_failures(self) -> Tensor:
        """Return which characters (N,) fell, left their clips, or can no longer reach the goal."""
        fallen = super().compute_failures()
        if not self.env_cfg.enable_early_termination:
            return fallen
        if self._off_clip is not None and self.is_training:
            self.extras["off_clip"] = (self._off_clip & ~fallen).to(self.rl_device)
            fallen = fallen | self._off_clip
        if not self._forgives_failures and (missed := self._missed_goals()) is not None:
            fallen = fallen | missed
        return fallen

    def post_physics_step(self) -> None:
        """Run the base method, then add the step, even a terminal one, to the AMP history."""
        super().post_physics_step()
        if self._starts.adaptive is not None:
            ended = (self.done_buf != Done.RUNNING) & (self._starts.clips >= 0)
            env_ids = ended.nonzero().flatten()
            failed = self.done_buf[env_ids] == Done.FAILED
            adaptive, starts = self._starts.adaptive, self._starts
            bins = adaptive.bins_of(starts.clips[env_ids], starts.times_s[env_ids])
            adaptive.count(bins, self.progress_buf[env_ids], failed)
        newest, history = self.current_amp_features().unsqueeze(1), self._amp_obs_buf
        window = torch.cat((newest, history[:, :-1]), dim=1)
        history.copy_(window)
        self.extras["amp_obs"] = window.flatten(1).to(self.rl_device, non_blocking=True)

    # --- demonstrations ----------------------------------------------------------------------

    def fetch_amp_obs_demo(self, num_samples: int) -> Tensor:
        """Return AMP observations (n, F) of random clip times on rl_device.

        Clips are drawn by weight. As in ASE, the steps of an observation lie inside the clip.
        IsaacGymEnvs extrapolates before the start of a clip.
        """
        return self._motions.windows(*self._motions.draw_windows(num_samples)).to(self.rl_device)

    def fetch_amp_obs_demo_pairs(self, num_samples: int, apart_s: float = 1.0) -> Tensor:
        """Draw pairs (n, 2, F) of AMP observations at most `apart_s` apart in one clip."""
        return self._motions.draw_pairs(num_samples, apart_s).to(self.rl_device)

    @property
    def num_skill_commands(self) -> int:
        """Number C of values in a command (see `CommandedSkillEnv`)."""
        return self.goal.num_commands

    def fetch_commanded_demos(self, num_samples: int) -> tuple[Tensor, Tensor]:
        """Draw AMP observations (n, F), and return them with the commands (n, C) of their clips."""
        motion_ids, times = self._motions.draw_windows(num_samples)
        ahead = self._motions.ahead(motion_ids, times, self.goal.look_ahead_s)
        commands = self.goal.commands_of_clips(self._clips_ahead(*ahead))
        amp_obs = self._motions.windows(motion_ids, times)
        return amp_obs.to(self.rl_device), commands.to(self.rl_device)

    def command_skills(self, env_ids: Tensor, commands: Tensor) -> None:
        """Give commands (n, C) to characters (n,)."""
        self.goal.command(env_ids.to(self.device), commands.to(self.device))

    def fetch_tracking_demo(self, num_samples: int, with_goal: bool = True) -> TrackingDemo | None:
        """Draw states from the clips, and return them with actions that continue the motion.

        A drive with the target q + kd / kp * v exerts no torque at position q and velocity v. Here
        q and v are those of the next control step. Call this method only before a reset of all
        environments, because it may overwrite their states.

        Args:
            num_samples: n.
            with_goal: whether the observations include the goal.

        Returns:
            The samples on rl_device, or None if clips do not determine the observation of the
            character or if actions are torques.
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
        reaches_goal = False
        if with_goal and self.goal.num_task_obs > 0:
            ahead = motions.ahead(motion_ids, times, self.goal.look_ahead_s)
            goal = self.goal.observe_clips(self._clips_ahead(*ahead))
            reaches_goal = goal is not None
            if goal is None:  # the actor learns to follow the clips whatever the goal is
                self.goal.reset(torch.arange(self.num_envs, device=self.device))
                drawn = self.goal.observe(None)
                goal = drawn[torch.randint(len(drawn), (num_samples,), device=self.device)]
            obs = torch.cat((obs, goal), dim=-1)
        _, near, far = states[1].view(3, num_samples, -1)
        # Exponential maps of consecutive states may jump by 2 pi.
        change = torch.remainder(far - near + torch.pi, 2 * torch.pi) - torch.pi
        kp, kd = -torch.from_numpy(self._model.actuator_biasprm[:, 1:3]).float().t()
        leads_s = torch.where(kp > 0, kd / kp.clamp(min=1e-9), 0.0).to(self.device)
        targets = near + leads_s * change / (2 * dt_s)
        actions = ((targets - self._action_offset) / self._action_scale).clamp(-1.0, 1.0)
        amp_obs = motions.windows(motion_ids, times)
        tensors = (rows.to(self.rl_device) for rows in (obs, actions, amp_obs))
        return TrackingDemo(*tensors, reaches_goal=reaches_goal)

    def _observe_clip(self, states: CharacterState) -> Tensor | None:
        """Return observations of clip states, or None if these do not determine observations."""
        return self._amp_features(states)

    def windows_of_clips(self) -> list[Tensor]:
        """Return for each clip the AMP observations (W, F) of all its control steps."""
        return [windows.to(self.rl_device) for windows in self._motions.windows_of_clips()]

    # --- reset -------------------------------------------------------------------------------

    def reset_state(self, env_ids: Tensor) -> None:
        """Start episodes in the default pose or in clips (key `stateInit`), and draw goals."""
        mode = self.env_cfg.state_init
        reference_ids, default_ids = env_ids, env_ids[:0]
        if mode == "Default":
            reference_ids, default_ids = env_ids[:0], env_ids
        elif mode == "Hybrid":
            from_clip = torch.rand(len(env_ids), device=self.device) < self.env_cfg.hybrid_init_prob
            reference_ids, default_ids = env_ids[from_clip], env_ids[~from_clip]
        self._reference_env_ids = reference_ids
        if len(reference_ids) > 0:
            starts = self._starts.next(reference_ids)
            root_states, dof_pos, dof_vel, self._reference_history, *ahead = starts
            if self.motion_lib.num_motions() == 1:
                self.keep_to_clips(reference_ids)
            self.simulation.write_state(reference_ids, root_states, dof_pos, dof_vel)
        if len(default_ids) > 0:
            self._write_default_pose(default_ids)
        self.goal.reset(env_ids)
        if len(reference_ids) > 0:
            self.goal.start_in_clips(reference_ids, self._clips_ahead(*ahead))

    def _clips_ahead(self, root_states: Tensor, key_pos: Tensor) -> ClipsAhead:
        # A goal that looks at no times gets no bodies.
        bodies = zip(self.key_body_names(), key_pos.unbind(2), strict=False)
        return ClipsAhead(root_states, dict(bodies))

    def robot_description(self) -> RobotDescription:
        """Run the base method, and use the start of the first clip if episodes start in clips."""
        description = super().robot_description()
        if self.env_cfg.state_init == "Default":
            return description
        first = torch.zeros(1, dtype=torch.int64, device=self.device)
        states = self._motions.states(first, first.float(), first)
        return description._replace(start=RobotState(*(rows[0] for rows in states[:3])))

    def reset(self) -> dict[str, Tensor]:
        """Discard drawn starts, whose number depends on the past, and start all episodes."""
        self._starts.clear()
        return super().reset()

    def reset_idx(self, env_ids: Tensor) -> None:
        """Start episodes, and fill the AMP history with the steps before the start."""
        self._starts.clips[env_ids] = -1
        self.leave_clips(env_ids)
        super().reset_idx(env_ids)
        self._start_histories(env_ids)

    @torch.inference_mode()
    def _start_histories(self, env_ids: Tensor) -> None:
        now = self.current_amp_features(env_ids)
        # Before a start in the default pose, the history holds a character at rest.
        standing = now.unsqueeze(1).expand(-1, self.env_cfg.num_amp_obs_steps, -1)
        self._amp_obs_buf.index_copy_(0, env_ids, standing)
        if len(self._reference_env_ids) > 0:
            before = self._amp_obs_buf[:, 1:]
            before.index_copy_(0, self._reference_env_ids, self._reference_history)
