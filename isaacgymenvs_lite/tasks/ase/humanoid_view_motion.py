"""HumanoidViewMotion: the character is moved along the clips, as ASE's task of that name."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.ase.humanoid_ase import HumanoidASE
from isaacgymenvs_lite.tasks.ase.humanoid_ase_config import HumanoidASEConfig


class HumanoidViewMotion(HumanoidASE):
    """Plays clips without physics: environment i starts with clip i, and goes on to the next.

    Actions have no effect. A step is one control step of playback, and an episode one clip.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.dt = self._playback_dt

    def _read_env_config(self, env: dict[str, Any]) -> HumanoidASEConfig:
        config = super()._read_env_config(env)
        self._playback_dt = config.control_freq_inv * self.sim_cfg.dt
        # One simulator call a step: what it computes is overwritten.
        return dataclasses.replace(config, control_freq_inv=1, pd_control=False)

    def _change_model(self, spec: mujoco.MjSpec) -> None:
        super()._change_model(spec)
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 0

    def allocate_buffers(self) -> None:
        """Add what is played in each environment, (N,)."""
        super().allocate_buffers()
        clips = torch.arange(self.num_envs, device=self.device)
        self._motion_ids = clips % self._motion_lib.num_motions()

    def action_scaling(self) -> None:
        """Return None: actions do nothing."""
        return None

    def pre_physics_step(self, actions: Tensor) -> None:
        """As the base, without torques."""
        super().pre_physics_step(torch.zeros_like(actions))

    def post_physics_step(self) -> None:
        """Show the clips at the time of this step; then as the base."""
        env_ids = torch.arange(self.num_envs, device=self.device)
        self._show(env_ids, self.progress_buf + 1)
        super().post_physics_step()

    def _show(self, env_ids: Tensor, steps: Tensor) -> None:
        motion_ids = self._motion_ids.index_select(0, env_ids)
        state = self._motion_lib.get_motion_state(motion_ids, steps * self._playback_dt)
        root_states = torch.zeros(len(env_ids), 13, device=self.device)
        root_states[:, :3], root_states[:, 3:7] = state.root_pos, state.root_rot
        at_rest = torch.zeros_like(state.dof_vel)
        self.simulation.write_state(env_ids, root_states, state.dof_pos, at_rest)

    def compute_reset(self) -> None:
        """End the episodes whose clips are over; none is a failure."""
        lengths = self._motion_lib.get_motion_length(self._motion_ids)
        self.reset_buf.copy_(self.progress_buf * self._playback_dt > lengths)
        self._terminate_buf.zero_()

    def _reset_actors(self, env_ids: Tensor) -> None:
        """Go on to the next clips; the first ones stay."""
        is_over = self.progress_buf.index_select(0, env_ids) > 0
        clips = self._motion_ids.index_select(0, env_ids) + is_over * self.num_envs
        self._motion_ids.index_copy_(0, env_ids, clips % self._motion_lib.num_motions())
        self._show(env_ids, torch.zeros_like(env_ids))
        self._reference_env_ids = env_ids[:0]
        self.goal.reset(env_ids)
