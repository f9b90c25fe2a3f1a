"""Base classes of all agents: they check what is restored, learned and saved.

rl_games' own training loop loads any checkpoint unchecked, continues with networks that are nan,
writes them over good ones, and makes no periodic checkpoint before the first episode has ended.
"""

from __future__ import annotations

import copy
import logging
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from rl_games.algos_torch.a2c_continuous import A2CAgent
from torch import Tensor

from isaacgymenvs_lite.checkpoints.files import Retention, load_checkpoint, save_checkpoint
from isaacgymenvs_lite.checkpoints.packed import POLICY_KEY
from isaacgymenvs_lite.distributed.group import current_group
from isaacgymenvs_lite.errors import ConfigError, NotFiniteError
from isaacgymenvs_lite.learning.diverged import RolloutMask
from isaacgymenvs_lite.learning.restoring import Fitting, Parts
from isaacgymenvs_lite.learning.resuming import Resuming

log = logging.getLogger(__name__)

# Rows of a rollout -> their name in messages; each may be the cause of the next.
_ROLLOUT = {
    "obses": "observations",
    "states": "states",
    "values": "values",
    "mus": "mean actions",
    "sigmas": "standard deviations",
    "actions": "actions",
    "rewards": "rewards",
    "amp_obs": "AMP observations",
    "disc_rewards": "style rewards",
}
_OF_TASK = ("obses", "states", "rewards", "amp_obs")
# Statistics of episodes that processes share.
_METERS = ("game_rewards", "game_shaped_rewards", "game_lengths")


class Safeguards(Resuming):
    """Checkpoints that fit and that are finite, for every agent; a base before rl_games' class."""

    game_rewards: Any
    rewards_shaper: Any
    nn_dir: str
    _restored_from = ""
    _last_saved: Path | None = None
    _last_periodic = ""
    _retention: Retention | None = None
    best_is_measured = False
    """Whether `save_best` alone writes the best checkpoint."""
    _has_learned = False

    def _parts(self) -> Parts:
        """Return the entries of a checkpoint that the agent loads."""
        raise NotImplementedError

    # --- restoring -------------------------------------------------------------------------

    def restore(self, fn: str, set_epoch: bool = True) -> None:
        """Continue from the checkpoint `fn`.

        Raises:
            CheckpointError: it cannot be used; the agent is unchanged then.
        """
        self._restored_from = str(fn)
        read = self.read_resumed if self.config.get("resume") else load_checkpoint
        self.set_full_state_weights(read(fn), set_epoch)

    def set_full_state_weights(self, weights: dict[str, Any], set_epoch: bool = True) -> None:
        """Load a checkpoint, once all of it fits; with a packed policy a new training begins.

        Raises:
            CheckpointError: it cannot be used; the agent is unchanged then.
        """
        is_policy, parts = POLICY_KEY in weights, self._parts()
        if is_policy:  # optimisers and counts are as a new training has them
            own = {
                key: {**each.state_dict(), "state": {}} for key, each in parts.optimizers.items()
            }
            own |= {key: each.state_dict() for key, each in parts.others.items()}
            weights = {**weights, **own, "epoch": 0, "frame": 0}
        fitted = Fitting(self._source).parts(weights, parts)
        super().set_full_state_weights(fitted, set_epoch)  # type: ignore[safe-super]
        if is_policy:
            log.info("%s: a new training begins with the networks of this policy", self._source)

    def check_fits(self, weights: Mapping[str, Any], source: str) -> None:
        """Check that the agent could load a checkpoint from `source`, `checkpoint=FILE`.

        Raises:
            CheckpointError: the checkpoint does not fit.
        """
        Fitting(source).parts(weights, self._parts())

    def train(self) -> Any:
        """Train as rl_games.

        Raises:
            ConfigError: the restored training has reached the last epoch.
            NotFiniteError: the policy cannot sample actions: observations or networks are broken.
        """
        if self._restored_from and self.epoch_num >= self.max_epochs > 0:
            raise ConfigError(
                f"{self._source}: its last epoch was {self.epoch_num}, and max_epochs is"
                f" {self.max_epochs}; to go on give more of them: max_iterations=N, in all"
            )
        try:
            return super().train()
        except (RuntimeError, ValueError):
            self._check_learned()
            rows = self.obs["obs"] if isinstance(self.obs, dict) else self.obs
            if isinstance(rows, Tensor):
                self._check_rows({"obses": rows.unsqueeze(0)}, self._steps_of_epoch)
            raise

    @property
    def _steps_of_epoch(self) -> int:
        """Policy steps of the rollout so far."""
        raise NotImplementedError

    @property
    def _source(self) -> str:
        key = "resume" if self.config.get("resume") else "checkpoint"
        return f"{key}={self._restored_from or '(given as a dictionary)'}"

    # --- saving ----------------------------------------------------------------------------

    def save(self, fn: str) -> None:
        """Write a checkpoint to `<fn>.pth`, in the main process.

        Raises:
            NotFiniteError: the networks are not finite; nothing is written.
        """
        if self.best_is_measured and os.path.basename(fn) == self.config["name"]:
            return  # rl_games chooses the best by noisy episodes that may be old
        self._write_checkpoint(fn)

    def save_best(self) -> None:
        """Write the run's best checkpoint."""
        self._write_checkpoint(os.path.join(self.nn_dir, self.config["name"]))

    def _write_checkpoint(self, fn: str) -> None:
        if not current_group().is_main:
            return
        self._check_learned()
        # At the last epoch rl_games writes `..._rew__1.5_` after the periodic `..._rew_1.5`.
        of_epoch = f"last_{self.config['name']}_ep_{self.epoch_num}_rew_"
        if os.path.basename(fn).startswith(of_epoch):
            if self._last_periodic.startswith(of_epoch):
                return
            fn = re.sub(r"_rew__(\S+)_$", r"_rew_\1", fn)
        state: Any = self.get_full_state_weights()
        saved = save_checkpoint(fn, state)
        if saved is None:
            return
        self._last_saved = saved
        if saved.name.startswith(f"last_{self.config['name']}_"):
            self._last_periodic = saved.name
            self._retention = self._retention or Retention(self.config.get("keep_checkpoints", 0))
            self._retention.written(saved, self.epoch_num)

    def save_before_first_episode(self) -> None:
        """Write the periodic checkpoint that rl_games leaves out before it has a mean reward."""
        if self.save_freq > 0 and self.epoch_num % self.save_freq == 0:
            self._save_without_reward()

    def _save_without_reward(self) -> None:
        """Write a checkpoint of this epoch unless a mean reward exists: rl_games writes it then."""
        if self.game_rewards.current_size > 0:
            return
        # rl_games' name of the last checkpoint in this case.
        name = f"last_{self.config['name']}_ep_{self.epoch_num}_rew_{-torch.inf}"
        self.save(os.path.join(self.nn_dir, name))

    # --- numbers that are not finite -------------------------------------------------------

    def _check_learned(self) -> None:
        """Check networks, normalisers and the moments of optimisers.

        Raises:
            NotFiniteError: one is not finite.
        """
        self._check_finite(dict(_tensors_of(self._parts())))

    def _check_finite(self, tensors: Mapping[str, Tensor]) -> None:
        """Check tensors, and name up to three that are not finite.

        Raises:
            NotFiniteError: one is not finite.
        """
        if _all_finite(tensors.values()):
            return
        broken = [name for name, tensor in tensors.items() if not bool(tensor.isfinite().all())]
        if broken:
            more = f" and {len(broken) - 3} more" if len(broken) > 3 else ""
            are = "are" if len(broken) > 1 else "is"
            raise self._not_finite(f"{', '.join(broken[:3])}{more} {are} not finite")

    def _not_finite(self, what: str) -> NotFiniteError:
        """Return the error that ends the training."""
        good = self._good_checkpoint
        after = f"go on from the last good checkpoint, {good}," if good else "start again"
        return self._end(
            f"{what} in epoch {self.epoch_num}, and networks do not recover from that: {after}"
            f" with {self._steadier_settings()}" + ("" if good else "; no checkpoint was saved yet")
        )

    def _end(self, message: str) -> NotFiniteError:
        """Return an error, and write its message to TensorBoard."""
        if self.writer is not None:  # only the main process has one
            self.writer.add_text("advice", message, self.frame)
        return NotFiniteError(message)

    def _steadier_settings(self) -> str:
        """Return the settings to change when networks have become nan, with current values."""
        rate = float(self.config["learning_rate"])
        return (
            f"train.params.config.learning_rate={rate / 2:g} (now {rate:g}),"
            " train.params.config.truncate_grads=True or train.params.config.mixed_precision=False"
        )

    @property
    def _good_checkpoint(self) -> str:
        """`checkpoint=<the newest one that was found finite>`, '' if there is none."""
        file = self._last_saved or self._restored_from
        return f"checkpoint={file}" if file else ""

    def _check_rows(self, rows: Mapping[str, Tensor], first_step: int = 0) -> None:
        """Check a rollout: rows (steps, N, ...) by rl_games' names, from a step of the epoch on.

        Raises:
            NotFiniteError: a value is not finite; the message has its name, place and time.
        """
        given = {
            name: rows[name].flatten(2) if rows[name].dim() > 2 else rows[name].unsqueeze(-1)
            for name in _ROLLOUT
            if isinstance(rows.get(name), Tensor) and rows[name].is_floating_point()
        }
        if _all_finite(given.values()):
            return
        places = [
            (*place, name)
            for name, values in given.items()
            for place in (~values.isfinite()).any(dim=-1).nonzero()[:1].tolist()
        ]
        if not places:
            return
        step, env, name = min(places, key=lambda place: place[0])
        numbers = given[name][step, env]
        where = (
            f"{_ROLLOUT[name]} of environment {env} hold"
            f" {numbers[~numbers.isfinite()][0].item()} at step {first_step + step} of epoch"
            f" {self.epoch_num}"
        )
        if name not in _OF_TASK:
            raise self._not_finite(f"{where}: the policy is not finite")
        if self._has_learned:
            # PPO's networks are unchanged since their last check; SAC's may not be: save checks.
            self.save(os.path.join(self.nn_dir, f"{self.config['name']}_interrupted"))
        if name == "rewards" and self.rewards_shaper.log_val:
            raise self._end(
                f"{where}: reward_shaper.log_val=True takes their logarithm, and they are not above"
                " 0; raise train.params.config.reward_shaper.shift_value, or set log_val=False"
            )
        good = self._good_checkpoint
        after = f", and go on from the last good checkpoint, {good}" if good else ""
        raise self._end(
            f"{where}: the task returned a number that is not finite; fix its computation{after}"
        )


class DataParallel(A2CAgent):
    """PPO of several processes, each with its own environments; of one, it is rl_games' PPO.

    rl_games averages gradients, KL and the decision to end over the processes, but its constructor
    starts NCCL: the agent is made as in a single process, and joins the others before its first
    epoch. This class adds equal parameters at the start, and frames and statistics of episodes of
    all processes. Normalisers and advantages are in `distributed.moments`.
    """

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
        """Give all processes the learned tensors of the main process, once.

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


class PPOSafeguards(Safeguards, DataParallel):
    """rl_games' PPO with these checks; the base of PPOAgent and CommonAgent.

    The rollout is checked before the update, losses and networks before rl_games reports them and
    saves.
    """

    stored = (
        *("game_shaped_rewards.mean", "game_shaped_rewards.current_size"),
        *("mean_rewards", "last_lr", "entropy_coef"),
        *("central_value_net.lr", "central_value_net.epoch_num", "central_value_net.frame"),
    )
    stored_episodes = ("current_shaped_rewards", "rnn_states", "central_value_net.rnn_states")

    _mask: RolloutMask

    @property
    def _steps_of_epoch(self) -> int:
        return self._mask.num_steps % self.horizon_length

    def _parts(self) -> Parts:
        modules: dict[str, Any] = {"model": self.model}
        optimizers: dict[str, Any] = {"optimizer": self.optimizer}
        optional = {"assymetric_vf_optimizer", "advantage_mean_std", "scaler"}
        if self.has_central_value:
            modules["assymetric_vf_nets"] = self.central_value_net
            optimizers["assymetric_vf_optimizer"] = self.central_value_net.optimizer
        if self.normalize_advantage and self.normalize_rms_advantage:
            modules["advantage_mean_std"] = self.advantage_mean_std
        scalers = {"scaler": self.scaler} if self.mixed_precision else {}
        return Parts(modules, optimizers, others=scalers, optional=frozenset(optional), counts=True)

    def update_epoch(self) -> int:
        """Count the epoch; rl_games calls this before each. Store, or go on from, a state."""
        self.take_own_meters()
        if self.has_joined:
            self.count_frames()
        self.go_on()
        self.join_others([tensor for _, tensor in _tensors_of(self._parts())])
        self.store_if_due()
        epoch_num: int = super().update_epoch()
        return epoch_num

    def store_training_state(self) -> None:
        """Write the state after this epoch; see `Resuming`."""
        self.take_own_meters()
        super().store_training_state()

    def _rates_restored(self) -> None:
        self.update_lr(float(self.last_lr))
        if self.has_central_value:
            self.central_value_net.update_lr(self.central_value_net.lr)

    def _check_batch_size(self) -> None:
        """Check that an epoch has a standard deviation, by which advantages are divided.

        Raises:
            ConfigError: it has one sample.
        """
        if self.batch_size < 2:
            raise ConfigError(
                "one environment with horizon_length 1 gives one sample per epoch, whose spread is"
                " undefined; expected at least two: raise num_envs or horizon_length"
            )

    def _enough_rows(self, num_rows: int) -> int:
        """Return how many rows of a rollout are left without diverged simulations.

        Raises:
            NotFiniteError: fewer than two, whose spread is undefined.
        """
        if num_rows < 2:
            raise self._end(
                f"the simulations diverged in all steps of epoch {self.epoch_num}: nothing is left"
                " to learn from; look at a file of <run>/diverged/ with python -m"
                " isaacgymenvs_lite.simulation.replay, and make task.sim.dt smaller or the"
                " actuators weaker"
            )
        return num_rows

    def restore_central_value_function(self, fn: str) -> None:
        """Load the asymmetric critic alone from the checkpoint `fn`.

        Raises:
            CheckpointError: it cannot be used; the agent is unchanged then.
        """
        key = "assymetric_vf_nets"
        parts = Parts({key: self.central_value_net})
        fitted = Fitting(f"checkpoint={fn}").parts(load_checkpoint(fn), parts)
        self.set_central_value_function_weights(fitted)

    def get_stats_weights(self, model_stats: bool = False) -> dict[str, Any]:
        """Return normaliser statistics, also of advantages, which rl_games reads but not writes."""
        state: dict[str, Any] = super().get_stats_weights(model_stats)
        if self.normalize_advantage and self.normalize_rms_advantage:
            state["advantage_mean_std"] = self.advantage_mean_std.state_dict()
        return state

    def set_stats_weights(self, weights: dict[str, Any]) -> None:
        """Load normaliser statistics; a checkpoint of rl_games has none of advantages."""
        if self.normalize_advantage and self.normalize_rms_advantage:
            own = {"advantage_mean_std": self.advantage_mean_std.state_dict()}
            weights = {**own, **weights}
        super().set_stats_weights(weights)

    def prepare_dataset(self, batch_dict: dict[str, Any]) -> None:
        """Make the training set of a rollout, once the rollout is found finite.

        Raises:
            NotFiniteError: it is not; the message has place and time.
        """
        self._check_rows(self.experience_buffer.tensor_dict)
        obs: Any = self.obs
        newest = {"obses": obs.get("obs"), "states": obs.get("states")}
        self._check_rows(
            {name: rows.unsqueeze(0) for name, rows in newest.items() if isinstance(rows, Tensor)},
            self.horizon_length,
        )
        self._check_finite({"returns": batch_dict["returns"]})
        self.share_meters()
        super().prepare_dataset(batch_dict)

    def write_stats(self, total_time: float, epoch_num: int, *args: Any) -> None:
        """Write rl_games' scalars of an epoch whose losses and networks are finite.

        Raises:
            NotFiniteError: they are not; rl_games has not saved them.
        """
        (_step_time, _play_time, _update_time, a_losses, c_losses, entropies, *_rest) = args
        losses = {"a_loss": a_losses, "c_loss": c_losses, "entropy": entropies}
        self._check_finite({name: torch.stack(each) for name, each in losses.items() if each})
        self._check_learned()
        self._has_learned = True
        super().write_stats(total_time, epoch_num, *args)
        self.save_before_first_episode()


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


def _tensors_of(parts: Parts) -> Iterator[tuple[str, Tensor]]:
    """Yield all learned tensors, with their names in a checkpoint."""
    yield from parts.tensors.items()
    for key, module in parts.modules.items():
        for name, tensor in chain(module.named_parameters(), module.named_buffers()):
            yield f"{key}.{name}", tensor
    for key, optimizer in parts.optimizers.items():
        parameters = (p for group in optimizer.param_groups for p in group["params"])
        for number, parameter in enumerate(parameters):
            for name, value in optimizer.state.get(parameter, {}).items():
                if isinstance(value, Tensor):
                    yield f"{key}.state.{number}.{name}", value


@torch.no_grad()
def _all_finite(tensors: Iterable[Tensor]) -> bool:
    """Return whether all numbers are finite; costs one sum each and one synchronisation.

    A sum out of range also returns False.
    """
    sums = [tensor.sum(dtype=torch.float32) for tensor in tensors]
    if not sums:
        return True
    device = sums[0].device
    return bool(torch.stack([each.to(device, non_blocking=True) for each in sums]).isfinite().all())
