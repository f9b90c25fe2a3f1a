"""Mixin of PPO's agents: several processes train one policy, each with its own environments.

rl_games averages gradients, KL and the decision to end over the processes; it uses NCCL only, and
its constructor starts it. So the agent is made as in a single process, and joins the others before
its first epoch. What rl_games leaves out is here: equal parameters at the start, the frame and the
statistics of episodes of all processes. Normalisers and advantages are in `distributed.moments`.
"""

from __future__ import annotations

import copy
from typing import Any

from rl_games.algos_torch.a2c_continuous import A2CAgent
from torch import Tensor

from isaacgymenvs_lite.distributed.group import current_group
from isaacgymenvs_lite.errors import ConfigError

_METERS = ("game_rewards", "game_shaped_rewards", "game_lengths")


def leave_out_nccl(config: dict[str, Any]) -> None:
    """Keep rl_games' constructor from starting NCCL, in place; the agent joins the others later.

    Raises:
        ConfigError: there are no others.
    """
    if config.get("multi_gpu") and current_group().size == 1:
        raise ConfigError(
            "train.params.config.multi_gpu=True: this program trains in one process; start it with"
            " torchrun, and make and run the Runner in `with"
            " isaacgymenvs_lite.distributed.group.joined_group(device, timeout_s):`"
        )
    config["multi_gpu"] = False


class DataParallel(A2CAgent):
    """PPO of several processes; of one, it is rl_games' PPO as it is."""

    has_joined = False
    """Whether it trains together with the others."""
    _own_meters: dict[str, Any] | None = None

    # rl_games sets all three to a single process' values.
    @property
    def global_rank(self) -> int:
        """Rank of this process; 0 writes logs and checkpoints."""
        return current_group().rank

    @global_rank.setter
    def global_rank(self, rank: int) -> None: ...

    @property
    def local_rank(self) -> int:
        """Rank of this process on its machine."""
        return current_group().local_rank

    @local_rank.setter
    def local_rank(self, rank: int) -> None: ...

    @property
    def world_size(self) -> int:
        """Number of processes."""
        return current_group().size

    @world_size.setter
    def world_size(self, size: int) -> None: ...

    def join_others(self, tensors: list[Tensor]) -> None:
        """Start the training together; called before each epoch, of effect before the first.

        Args:
            tensors: all that is learned, which the main process gives to the others.

        Raises:
            PeerError: another process ended before.
            ConfigError: a normaliser that cannot be shared.
        """
        group = current_group()
        if self.has_joined or group.size == 1:
            return
        error = None
        if self.normalize_advantage and self.normalize_rms_advantage:
            error = ConfigError(
                "train.params.config.normalize_rms_advantage=True: data-parallel training has no"
                " moving statistics of advantages; set it to False"
            )
        group.fail_together(error)
        self.has_joined = True
        group.take_from_main_(tensors)
        self.multi_gpu = True
        # rl_games sends learning rates in float32: a resumed run has them rounded, too.
        self.update_lr(float(self.last_lr))
        if self.has_central_value:
            self.central_value_net.multi_gpu = True
            self.central_value_net.world_size = group.size
            self.central_value_net.update_lr(self.central_value_net.lr)

    def train(self) -> Any:
        """Train as rl_games."""
        result = super().train()
        if self.has_joined:
            self.count_frames()  # of the last epoch
        return result

    def count_frames(self) -> None:
        """Count the frames of an epoch, which rl_games does in the main process alone."""
        group = current_group()
        if not group.is_main:
            self.frame += self.curr_frames * group.size

    # --- statistics of episodes ------------------------------------------------------------

    def take_own_meters(self) -> None:
        """Take back the meters that this process updates, which `share_meters` has replaced."""
        own, self._own_meters = self._own_meters, None
        for name, meter in (own or {}).items():
            setattr(self, name, meter)

    def share_meters(self) -> None:
        """Replace the meters of finished episodes by all processes' meters, for one epoch's log.

        Their means are weighted by the numbers of episodes that the processes' meters hold.
        """
        group = current_group()
        if group.size == 1:
            return
        self._own_meters = {name: getattr(self, name) for name in _METERS}
        for name, own in self._own_meters.items():
            shared = copy.deepcopy(own)
            total = sum(group.gather(own.current_size))
            shared.mean = group.sum_(own.mean * own.current_size) / max(total, 1)
            if name != "game_lengths":
                # rl_games makes it (values,) and updates it to (1, values), which its log expects;
                # this process may have had no episode yet.
                shared.mean = shared.mean.view(1, -1)
            shared.current_size = min(total, own.max_size)
            setattr(self, name, shared)
