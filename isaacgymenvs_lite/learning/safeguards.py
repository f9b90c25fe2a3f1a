"""Base classes of all agents, which check networks that are restored, trained or saved.

rl_games' training loop does not check checkpoints; it continues with nan, and overwrites good
checkpoints by networks with nan. rl_games writes no periodic checkpoint before the first episode
has ended.
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

# Names of rollout tensors in error messages. The order is that in which a value that is not finite
# spreads: from observations to values.
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
# Episode statistics that processes share.
_METERS = ("game_rewards", "game_shaped_rewards", "game_lengths")


class Safeguards(Resuming):
    """Loads only checkpoints that fit, and saves only finite networks.

    In a list of base classes, this class stands before rl_games' agent.
    """

    game_rewards: Any
    rewards_shaper: Any
    obs: Any
    nn_dir: str
    _restored_from = ""
    _last_saved: Path | None = None
    _last_periodic = ""
    _retention: Retention | None = None
    best_is_measured = False
    """Whether the best checkpoint is written only by `save_best`."""
    _has_learned = False

    def _parts(self) -> Parts:
        """Return the objects that the agent loads from a checkpoint."""
        raise NotImplementedError

    # --- restoring -------------------------------------------------------------------------

    def restore(self, fn: str, set_epoch: bool = True) -> None:
        """Continue from the checkpoint `fn`, or raise CheckpointError."""
        self._restored_from = str(fn)
        read = self.read_resumed if self.config.get("resume") else load_checkpoint
        self.set_full_state_weights(read(fn), set_epoch)

    def set_full_state_weights(self, weights: dict[str, Any], set_epoch: bool = True) -> None:
        """Load a checkpoint if all of it fits.

        From a packed policy, a new training begins.
        """
        is_policy, parts = POLICY_KEY in weights, self._parts()
        if is_policy:  # Optimisers and counts are reset.
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
        """Raise CheckpointError unless a checkpoint fits; `source` is the user's argument."""
        Fitting(source).parts(weights, self._parts())

    def train(self) -> Any:
        """Train with rl_games' loop.

        Raises:
            ConfigError: the restored training has already reached its last epoch.
            NotFiniteError: actions cannot be sampled, because observations or networks are not
                finite.
        """
        if self._restored_from and self.epoch_num >= self.max_epochs > 0:
            raise ConfigError(
                f"{self._source}: its last epoch was {self.epoch_num}, and max_epochs is"
                f" {self.max_epochs}; to continue set a larger total: max_iterations=N"
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
        """The number of policy steps in the current rollout."""
        raise NotImplementedError

    @property
    def _source(self) -> str:
        key = "resume" if self.config.get("resume") else "checkpoint"
        return f"{key}={self._restored_from or '(given as a dictionary)'}"

    # --- saving ----------------------------------------------------------------------------

    def save(self, fn: str) -> None:
        """Write a checkpoint to `<fn>.pth` in the main process, if the networks are finite."""
        if self.best_is_measured and os.path.basename(fn) == self.config["name"]:
            return  # rl_games selects by noisy training rewards.
        self._write_checkpoint(fn)

    def save_best(self) -> None:
        """Write the run's best checkpoint."""
        self._write_checkpoint(os.path.join(self.nn_dir, self.config["name"]))

    def _write_checkpoint(self, fn: str) -> None:
        if not current_group().is_main:
            return
        self._check_learned()
        # In the last epoch, rl_games writes a second checkpoint `..._rew__1.5_` after the periodic
        # checkpoint `..._rew_1.5`.
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
        """Write the periodic checkpoint, which rl_games does not write without a mean reward."""
        if self.save_freq > 0 and self.epoch_num % self.save_freq == 0:
            self._save_without_reward()

    def _save_without_reward(self) -> None:
        """Write a checkpoint if no episode has ended, because rl_games then writes none."""
        if self.game_rewards.current_size > 0:
            return
        # rl_games gives this name to the last checkpoint.
        name = f"last_{self.config['name']}_ep_{self.epoch_num}_rew_{-torch.inf}"
        self.save(os.path.join(self.nn_dir, name))

    # --- values that are not finite --------------------------------------------------------

    def _check_learned(self) -> None:
        """Raise NotFiniteError if networks, normalisers or Adam's averages are not finite."""
        self._check_finite(dict(_tensors_of(self._parts())))

    def _check_finite(self, tensors: Mapping[str, Tensor]) -> None:
        """Raise NotFiniteError if tensors are not finite, with the names of up to three of them."""
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
            f"{what} in epoch {self.epoch_num}, and networks do not recover: {after} with"
            f" {self._steadier_settings()}" + ("" if good else "; no checkpoint was saved yet")
        )

    def _end(self, message: str) -> NotFiniteError:
        """Write the message to TensorBoard, and return it as an error."""
        if self.writer is not None:  # only the main process has one
            self.writer.add_text("advice", message, self.frame)
        return NotFiniteError(message)

    def _steadier_settings(self) -> str:
        """Return settings that may prevent nan, as text with the current values."""
        rate = float(self.config["learning_rate"])
        return (
            f"train.params.config.learning_rate={rate / 2:g} (now {rate:g}),"
            " train.params.config.truncate_grads=True or train.params.config.mixed_precision=False"
        )

    @property
    def _good_checkpoint(self) -> str:
        """The text `checkpoint=FILE` with the newest finite checkpoint, or '' if there is none."""
        file = self._last_saved or self._restored_from
        return f"checkpoint={file}" if file else ""

    def _check_rows(self, rows: Mapping[str, Tensor], first_step: int = 0) -> None:
        """Raise NotFiniteError if a value is not finite, with the name and place of the first one.

        `rows` are tensors (steps, N, ...) of a rollout, beginning with step `first_step` of the
        epoch.
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
            # `save` checks the networks, because SAC's networks may have changed since their last
            # check.
            self.save(os.path.join(self.nn_dir, f"{self.config['name']}_interrupted"))
        if name == "rewards" and self.rewards_shaper.log_val:
            raise self._end(
                f"{where}: reward_shaper.log_val=True takes the logarithm of a reward that is not"
                " positive; set it to False, or raise train.params.config.reward_shaper.shift_value"
            )
        good = self._good_checkpoint
        after = f", and go on from the last good checkpoint, {good}" if good else ""
        raise self._end(
            f"{where}: the task returned a value that is not finite; fix its computation{after}"
        )


def _of_group(name: str) -> Any:
    """Return a property that reads the process group, and ignores what rl_games assigns to it."""
    return property(lambda _: getattr(current_group(), name), lambda _, value: None)


class DataParallel(A2CAgent):
    """PPO in several processes, each with its own environments.

    A single process runs rl_games' PPO. rl_games averages gradients and KL divergences over the
    processes and ends all of them together, but its constructor starts NCCL. An agent is therefore
    constructed for a single process, and joins the other processes before its first epoch. The
    class also copies the initial parameters to all processes, counts frames, and shares episode
    statistics. `distributed.moments` shares the statistics of normalisers and advantages.
    """

    has_joined = False
    """Whether the agent has joined the other processes."""
    _own_meters: dict[str, Any] | None = None

    global_rank = _of_group("rank")
    local_rank = _of_group("local_rank")
    world_size = _of_group("size")

    def join_others(self, tensors: list[Tensor]) -> None:
        """Copy the learned tensors of the main process to all processes, in the first call only."""
        group = current_group()
        if self.has_joined or group.size == 1:
            return
        group.fail_together()
        self.has_joined = True
        group.take_from_main_(tensors)
        self.multi_gpu = True
        # rl_games sends learning rates as float32, and a resumed run must round them in the same
        # way.
        self.update_lr(float(self.last_lr))
        if self.has_central_value:
            self.central_value_net.multi_gpu = True
            self.central_value_net.world_size = group.size
            self.central_value_net.update_lr(self.central_value_net.lr)

    def train(self) -> Any:
        """Train, and count the frames of the last epoch."""
        result = super().train()
        if self.has_joined:
            self.count_frames()
        return result

    def count_frames(self) -> None:
        """Count an epoch's frames in all processes but the main one, where rl_games counts them."""
        group = current_group()
        if not group.is_main:
            self.frame += self.curr_frames * group.size

    # --- statistics of episodes ------------------------------------------------------------

    def take_own_meters(self) -> None:
        """Restore the meters of this process after `share_meters`."""
        own, self._own_meters = self._own_meters, None
        for name, meter in (own or {}).items():
            setattr(self, name, meter)

    def share_meters(self) -> None:
        """Replace the episode meters by means over all processes, until the epoch is logged."""
        group = current_group()
        if group.size == 1:
            return
        self._own_meters = {name: getattr(self, name) for name in _METERS}
        for name, own in self._own_meters.items():
            shared = copy.deepcopy(own)
            total = sum(group.gather(own.current_size))
            shared.mean = group.sum_(own.mean * own.current_size) / max(total, 1)
            if name != "game_lengths":
                # rl_games' log expects the shape (1, values). A meter gets this shape with its
                # first episode, and this process may have had none.
                shared.mean = shared.mean.view(1, -1)
            shared.current_size = min(total, own.max_size)
            setattr(self, name, shared)


class PPOSafeguards(Safeguards, DataParallel):
    """rl_games' PPO with the checks of `Safeguards`; base class of PPOAgent and CommonAgent.

    The rollout is checked before the update; losses and networks are checked before networks are
    saved.
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
        optional = frozenset(("assymetric_vf_optimizer", "scaler"))
        if self.has_central_value:
            modules["assymetric_vf_nets"] = self.central_value_net
            optimizers["assymetric_vf_optimizer"] = self.central_value_net.optimizer
        scalers = {"scaler": self.scaler} if self.mixed_precision else {}
        return Parts(modules, optimizers, others=scalers, optional=optional, counts=True)

    def update_epoch(self) -> int:
        """Write a training state if it is due, or restore one, and then count the new epoch."""
        self.take_own_meters()
        if self.has_joined:
            self.count_frames()
        self.go_on()
        self.join_others([tensor for _, tensor in _tensors_of(self._parts())])
        self.store_if_due()
        epoch_num: int = super().update_epoch()
        return epoch_num

    def store_training_state(self) -> None:
        """Write the training state after this epoch."""
        self.take_own_meters()
        super().store_training_state()

    def _rates_restored(self) -> None:
        self.update_lr(float(self.last_lr))
        if self.has_central_value:
            self.central_value_net.update_lr(self.central_value_net.lr)

    def _check_batch_size(self) -> None:
        """Raise ConfigError if an epoch has one sample, which has no standard deviation."""
        if self.batch_size < 2:
            raise ConfigError(
                "one environment with horizon_length 1 gives one sample per epoch, which has no"
                " standard deviation; raise num_envs or horizon_length"
            )

    def _enough_rows(self, num_rows: int) -> int:
        """Return `num_rows`, the number of valid transitions; raise an error if it is below 2."""
        if num_rows < 2:
            raise self._end(
                f"the simulations diverged in all steps of epoch {self.epoch_num}: no transitions"
                " are left; look at a file of <run>/diverged/ with python -m"
                " isaacgymenvs_lite.simulation.replay, and make task.sim.dt smaller or the"
                " actuators weaker"
            )
        return num_rows

    def restore_central_value_function(self, fn: str) -> None:
        """Load only the asymmetric critic from the checkpoint `fn`."""
        key = "assymetric_vf_nets"
        parts = Parts({key: self.central_value_net})
        fitted = Fitting(f"checkpoint={fn}").parts(load_checkpoint(fn), parts)
        self.set_central_value_function_weights(fitted)

    def prepare_dataset(self, batch_dict: dict[str, Any]) -> None:
        """Check that the rollout is finite, and fill the dataset."""
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
        """Check that losses and networks are finite, and write rl_games' scalars."""
        (_step_time, _play_time, _update_time, a_losses, c_losses, entropies, *_rest) = args
        losses = {"a_loss": a_losses, "c_loss": c_losses, "entropy": entropies}
        self._check_finite({name: torch.stack(each) for name, each in losses.items() if each})
        self._check_learned()
        self._has_learned = True
        super().write_stats(total_time, epoch_num, *args)
        self.save_before_first_episode()


def leave_out_nccl(config: dict[str, Any]) -> None:
    """Change `config` in place, so that rl_games' constructor does not start NCCL."""
    if config.get("multi_gpu") and current_group().size == 1:
        raise ConfigError(
            "train.params.config.multi_gpu=True: this program trains in one process; start it with"
            " torchrun, and make and run the Runner in `with"
            " isaacgymenvs_lite.distributed.group.joined_group(device, timeout_s):`"
        )
    config["multi_gpu"] = False


def _tensors_of(parts: Parts) -> Iterator[tuple[str, Tensor]]:
    """Yield the names and values of all learned tensors in a checkpoint."""
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
    """Return whether the sum of each tensor is finite.

    If a sum of finite values overflows, False is returned as well.
    """
    sums = [tensor.sum(dtype=torch.float32) for tensor in tensors]
    if not sums:
        return True
    device = sums[0].device
    return bool(torch.stack([each.to(device, non_blocking=True) for each in sums]).isfinite().all())
