"""HumanoidASEGetup: skills that include getting up, as ASE's HumanoidAMPGetup."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.ase.humanoid_ase import HEAD, GetupConfig, HumanoidASE
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.vec_task import Done

_FALL_ACTION = 0.5
# Time (s) after which a dropped character lies still.
_FALL_S = 2.5


class HumanoidASEGetup(HumanoidASE):
    """HumanoidASE in which some episodes start on the ground.

    After some falls the next episode goes on from where the character lies, and some others start
    from a fallen pose. For `recoverySteps` control steps neither falls nor the time limit end them.
    Without a goal the reward of the task says how near root and head are to their heights in
    standing: the mean of both, 1 there, 0 on the ground and at twice the height. The root alone is
    lifted with the hands on the ground, and a character that is paid for more height leaps.
    ASE's, a constant 1, says nothing about getting up.

    Attributes:
        fallen_root_states: (N, 13) of characters that lie on the ground at rest.
        fallen_dof_pos: (N, D) rad, likewise.
        recovery_steps_left: (N,) control steps that each character has left to get up.
    """

    settings_class = GetupConfig
    env_cfg: GetupConfig

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.fallen_root_states, self.fallen_dof_pos = self._let_fall()
        # Some of the first episodes go on from here: as if all had fallen a while ago.
        self.done_buf.fill_(Done.FAILED)
        self._amp_obs_buf.copy_(self.current_amp_features().unsqueeze(1))

    def allocate_buffers(self) -> None:
        """Add the time that each character has left to get up."""
        super().allocate_buffers()
        self.recovery_steps_left = torch.zeros_like(self.progress_buf)

    @torch.inference_mode()
    def _let_fall(self) -> tuple[Tensor, Tensor]:
        """Drop all characters in random attitudes; root states (N, 13) and joints (N, D) at rest.

        The characters stay there: their first episodes may start so.
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
        """As the base, and count the time to get up."""
        super().pre_physics_step(actions)
        self.recovery_steps_left.sub_(1).clamp_(min=0)

    def compute_reward_terms(self) -> Terms:
        """Return how far the character is up, 0 to 1; with a goal the goal's reward."""
        if self.goal.num_obs > 0:
            return super().compute_reward_terms()
        off = (self._heights_m() / self._standing_m - 1.0).abs()
        return {"upright": (1.0 - off).clamp(min=0.0).mean(dim=1)}

    def _heights_m(self) -> Tensor:
        """Return the heights (N, 2) m of root and head; of a humanoid without a head (N, 1)."""
        sim = self.simulation
        head = [sim.body_names.index(HEAD)] if HEAD in sim.body_names else []
        return torch.cat((sim.root_states[:, 2:3], sim.body_pos[:, head, 2]), dim=1)

    def compute_failures(self) -> Tensor:
        """As the base, but characters that have time left to get up do not fail."""
        return super().compute_failures() & (self.recovery_steps_left == 0)

    def compute_time_outs(self) -> Tensor:
        """As the base, but characters that have time left to get up may go on."""
        return super().compute_time_outs() & (self.recovery_steps_left == 0)

    def reset_state(self, env_ids: Tensor) -> None:
        """Leave some where they lie, lay some down, and start the others as HumanoidASE."""
        cfg = self.env_cfg
        # A diverged simulation counts as a fall, but has no pose to go on from.
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
        """As the base, except for characters that go on: their motion is continuous."""
        starts_new = ~torch.isin(env_ids, self._going_on_ids)
        super()._start_histories(env_ids[starts_new])
