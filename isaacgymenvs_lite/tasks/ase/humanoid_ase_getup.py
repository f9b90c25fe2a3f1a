"""HumanoidASEGetup: characters learn skills and getting up, as in ASE's HumanoidAMPGetup."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.ase.humanoid_ase import HEAD, GetupConfig, HumanoidASE
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.vec_task import Done

_FALL_ACTION = 0.5
_FALL_S = 2.5  # dropped characters lie still after this time


class HumanoidASEGetup(HumanoidASE):
    """HumanoidASE in which some episodes start on the ground.

    After some falls, the next episode continues from the fallen pose. Some other episodes start in
    a random fallen pose. In the first `recoverySteps` control steps, neither a fall nor the time
    limit ends these two kinds of episodes.

    Without a goal, the reward is the mean of two terms, for the heights of root and head. A term is
    1 at the standing height, and 0 on the ground and at twice the standing height. With a reward of
    the root's height only, characters learn to lift the root while the hands stay on the ground.
    With a reward that grows beyond the standing height, characters learn to leap. With ASE's
    constant reward, characters do not learn to get up.

    Attributes:
        fallen_root_states: (N, 13) root states of characters at rest on the ground.
        fallen_dof_pos: (N, D) rad, joint positions of these characters.
        recovery_steps_left: (N,) remaining control steps to get up.
    """

    settings_class = GetupConfig
    env_cfg: GetupConfig

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.fallen_root_states, self.fallen_dof_pos = self._let_fall()
        # All characters count as fallen, so that some first episodes continue from the present
        # pose.
        self.done_buf.fill_(Done.FAILED)
        self._amp_obs_buf.copy_(self.current_amp_features().unsqueeze(1))

    def allocate_buffers(self) -> None:
        """Add the remaining time to get up."""
        super().allocate_buffers()
        self.recovery_steps_left = torch.zeros_like(self.progress_buf)

    @torch.inference_mode()
    def _let_fall(self) -> tuple[Tensor, Tensor]:
        """Drop all characters in random attitudes, and return roots (N, 13) and joints (N, D).

        The characters stay in their fallen poses, because their first episodes may start there.
        """
        n, sim = self.num_envs, self.simulation
        env_ids = torch.arange(n, device=self.device)
        self._write_default_pose(env_ids)
        self._standing_m = self._heights_m()[0]
        root_states = sim.root_states.clone()
        root_states[:, 3:7] = torch.nn.functional.normalize(torch.randn(n, 4, device=self.device))
        sim.write_state(env_ids, root_states, sim.dof_pos.clone(), sim.dof_vel.clone())
        actions = torch.empty(n, self.num_actions, device=self.device)
        actions.uniform_(-_FALL_ACTION, _FALL_ACTION)
        sim.set_controls(self.compute_controls(actions))
        for _ in range(round(_FALL_S / self.control_dt_s)):
            sim.step()
        root_states, dof_pos = sim.root_states.clone(), sim.dof_pos.clone()
        root_states[:, 7:] = 0.0
        return root_states, dof_pos

    def pre_physics_step(self, actions: Tensor) -> None:
        """Run the base method and count down the time to get up."""
        super().pre_physics_step(actions)
        self.recovery_steps_left.sub_(1).clamp_(min=0)

    def compute_reward_terms(self) -> Terms:
        """Return the goal's reward; for skills also the reward in [0, 1] of standing upright."""
        terms = super().compute_reward_terms()
        if self.goal.num_obs > 0:
            return terms
        terms.pop("task", None)  # the constant of a goal that asks for nothing
        off = (self._heights_m() / self._standing_m - 1.0).abs()
        return terms | {"upright": (1.0 - off).clamp(min=0.0).mean(dim=1)}

    def _heights_m(self) -> Tensor:
        """Return the heights (N, 2) m of root and head, or (N, 1) if there is no head."""
        sim = self.simulation
        head = [sim.body_names.index(HEAD)] if HEAD in sim.body_names else []
        return torch.cat((sim.root_states[:, 2:3], sim.body_pos[:, head, 2]), dim=1)

    def compute_failures(self) -> Tensor:
        """Return which characters (N,) are fallen and have no time left to get up."""
        return super().compute_failures() & (self.recovery_steps_left == 0)

    def compute_time_outs(self) -> Tensor:
        """Return which episodes (N,) reached the time limit and have no time left to get up."""
        return super().compute_time_outs() & (self.recovery_steps_left == 0)

    def reset_state(self, env_ids: Tensor) -> None:
        """Continue from falls, put some characters into fallen poses, and start others in clips."""
        cfg = self.env_cfg
        # A diverged simulation has no valid pose to continue from.
        lies_there = (self.done_buf == Done.FAILED) & ~self.simulation.failed
        fell = lies_there.index_select(0, env_ids)
        recovers = fell & (uniform(env_ids, 0.0, 1.0) < cfg.recovery_episode_prob)
        lies = ~recovers & (uniform(env_ids, 0.0, 1.0) < cfg.fall_init_prob)
        self._going_on_ids = env_ids[recovers]
        lying_ids, others = env_ids[lies], env_ids[~recovers & ~lies]
        super().reset_state(others)
        if len(lying_ids) > 0:
            poses = torch.randint(self.num_envs, (len(lying_ids),), device=self.device)
            dof_pos = self.fallen_dof_pos.index_select(0, poses)
            root_states = self.fallen_root_states.index_select(0, poses)
            at_rest = torch.zeros_like(dof_pos)
            self.simulation.write_state(lying_ids, root_states, dof_pos, at_rest)
        down = torch.cat((self._going_on_ids, lying_ids))
        self.goal.reset(down)
        self.recovery_steps_left.index_fill_(0, others, 0)
        self.recovery_steps_left.index_fill_(0, down, cfg.recovery_steps)

    def _start_histories(self, env_ids: Tensor) -> None:
        """Start new histories, except for characters that stay in their poses."""
        starts_new = ~torch.isin(env_ids, self._going_on_ids)
        super()._start_histories(env_ids[starts_new])
