"""Mixin of all agents: a resumed training gives exactly the results of an uninterrupted one.

An agent writes a training state at every periodic checkpoint and at the end. The training state
contains the state of the agent, the task, the observers and the random generators. A resumed
training loads the training state after the first reset of the environments and before its first
epoch.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

from rl_games.interfaces.base_algorithm import BaseAlgorithm

from isaacgymenvs_lite.checkpoints.training_state import (
    TrainingState,
    new_token,
    num_bytes,
    read_training_state,
    remove_other_states,
    write_training_state,
)
from isaacgymenvs_lite.distributed.group import current_group
from isaacgymenvs_lite.errors import CheckpointError, one_line
from isaacgymenvs_lite.run.event_writer import continue_log
from isaacgymenvs_lite.utils.state import read_generators, read_state, write_generators, write_state

log = logging.getLogger(__name__)
_FEW_EPOCHS = 20
_LARGE_BYTES = 2**25
_RATES = ("learning_rate", "actor_lr", "critic_lr", "alpha_lr")


class Resuming(BaseAlgorithm):
    """Writes training states, and resumes a training from one of them.

    Keys of `params.config`: `save_frequency` (epochs between two training states), `save_buffers`
    (whether to store replay buffers; by default large buffers are not stored in the first 20
    epochs), and `resume` (the file to resume from, which the runner sets).

    Attributes:
        stored: names of attributes that a training state contains in addition to the checkpoint.
            The names in all base classes are joined; `a.b` is attribute `b` of attribute `a`.
        stored_episodes: names of attributes with the state of the running episodes.
        stored_buffers: names of attributes that are replay buffers.
    """

    stored: ClassVar[tuple[str, ...]] = (
        *("game_rewards.mean", "game_rewards.current_size", "last_mean_rewards"),
        *("game_lengths.mean", "game_lengths.current_size", "algo_observer"),
    )
    stored_episodes: ClassVar[tuple[str, ...]] = (
        *("obs", "dones", "current_rewards", "current_lengths"),
    )
    stored_buffers: ClassVar[tuple[str, ...]] = ()

    config: dict[str, Any]
    epoch_num: int
    max_epochs: int
    frame: int
    save_freq: int
    algo_observer: Any
    ppo_device: Any
    vec_env: Any
    writer: Any
    experiment_dir: str
    _to_resume: TrainingState | None = None
    _resumed_from = ""
    _stored_epoch = -1
    _reported_size = False
    frames_before_log = 0
    """The next epoch writes its scalars to TensorBoard at `frame` plus this number."""

    # --- storing -----------------------------------------------------------------------------

    def train(self) -> Any:
        """Train, and write the training state at the end."""
        result = super().train()  # type: ignore[safe-super]  # rl_games' class comes after
        self.store_training_state()
        return result

    def store_if_due(self) -> None:
        """Write a training state if this epoch has a periodic checkpoint."""
        if self.save_freq > 0 and self.epoch_num > 0 and self.epoch_num % self.save_freq == 0:
            self.store_training_state()

    def store_training_state(self) -> None:
        """Write the training state after this epoch, unless it is already written.

        If writing fails, the failure is logged, the former training state stays, and the training
        continues. The main process writes last, because `resume=` looks for the main process' file.
        """
        if self._stored_epoch == self.epoch_num:
            return
        group = current_group()
        token = group.from_main(new_token())
        for is_turn in (not group.is_main, group.is_main):
            if group.any(is_turn and not self._write_state(token)):
                return
        if group.is_main:
            remove_other_states(Path(self.experiment_dir), self.epoch_num)
        self._stored_epoch = self.epoch_num

    def _write_state(self, token: str) -> bool:
        """Write the files of this process, and return whether that succeeded."""
        group, run = current_group(), Path(self.experiment_dir)
        try:
            buffers = self._read("stored_buffers") if self.config.get("save_buffers", True) else {}
            is_short = self.epoch_num < _FEW_EPOCHS and "save_buffers" not in self.config
            if is_short and num_bytes(buffers) > _LARGE_BYTES:
                buffers = {}  # A run as short as this is easily repeated.
            memory = {
                "learning_rates": self._learning_rates(),
                "task_settings": self._task_settings(),
                "agent": self._read("stored"),
                "episodes": self._read("stored_episodes"),
                "task": self._task.state_dict() if self._task is not None else None,
                "generators": read_generators(),
            }
            weights: Any = self.get_full_state_weights()
            state = TrainingState(weights, memory, buffers or None, group.size)
            files = write_training_state(run, state, self.epoch_num, token, group.rank)
        except Exception as error:  # A full disk or a user's task may fail.
            reason = one_line(getattr(error, "strerror", None) or error)
            message = "cannot write the training state of epoch %d below %s (%s); training goes on"
            log.warning(message, self.epoch_num, run, reason)
            return False
        if not self._reported_size:
            self._reported_size = True
            sizes = ", ".join(f"{file.name} {file.stat().st_size / 1e6:.1f} MB" for file in files)
            key = "; +train.params.config.save_buffers=False leaves the replay buffers out"
            log.info("training state for resume=: %s%s", sizes, key if len(files) > 1 else "")
        return True

    def _read(self, kind: str) -> dict[str, Any]:
        found = self._attributes(kind)
        return {name: read_state(getattr(holder, attribute)) for name, holder, attribute in found}

    def _attributes(self, kind: str) -> Iterator[tuple[str, Any, str]]:
        """Yield for each stored attribute its name in the list, its object and its name there."""
        listed = (name for base in type(self).__mro__ for name in base.__dict__.get(kind, ()))
        for name in dict.fromkeys(listed):
            holder: Any = self
            *path, attribute = name.split(".")
            for part in path:
                holder = getattr(holder, part, None)
            if hasattr(holder, attribute):
                yield name, holder, attribute

    def _learning_rates(self) -> list[float]:
        """Return the learning rates in the configuration."""
        return [float(self.config[key]) for key in _RATES if key in self.config]

    @property
    def _task(self) -> Any:
        """The task if it has a state, otherwise None."""
        task = getattr(self.vec_env, "env", None)
        return task if hasattr(task, "load_state_dict") else None

    def _task_settings(self) -> str:
        """Return a hash of the task's settings, the number of environments and the horizon."""
        task = getattr(self.vec_env, "env", None)
        cfg = getattr(task, "cfg", None) or {}
        sim = {key: value for key, value in (cfg.get("sim") or {}).items() if key != "physx"}
        sizes = [getattr(task, "num_envs", 0), getattr(self, "batch_size", 0)]
        parts = [*sizes, cfg.get("env"), sim, cfg.get("task")]
        text = json.dumps(parts, sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    # --- continuing --------------------------------------------------------------------------

    def read_resumed(self, fn: str) -> dict[str, Any]:
        """Return the checkpoint in a training state; `go_on` restores the rest of the state."""
        group = current_group()
        self._to_resume = read_training_state(Path(fn), group.rank, group.size)
        self._resumed_from = fn
        return self._to_resume.checkpoint

    def go_on(self) -> None:
        """Restore agent and task before the first epoch, or raise CheckpointError."""
        state, self._to_resume = self._to_resume, None
        if state is None:
            return
        try:
            fresh = self._write_memory(state)
        except Exception as error:  # The file may belong to another agent.
            raise CheckpointError(
                f"resume={self._resumed_from}: the training state does not fit ({one_line(error)});"
                f" start a new run with its networks: checkpoint={self._resumed_from}"
            ) from error
        if self.writer is not None:  # Only the main process has a writer.
            continue_log(self.writer, self.frame + self.frames_before_log)
        place = (self.epoch_num, self.frame, self._resumed_from)
        log.info("resumed after epoch %d, frame %d: %s", *place)
        if fresh:
            log.warning("not as if it had never stopped: %s", "; ".join(fresh))
        self._stored_epoch = self.epoch_num if state.memory is not None else -1

    def _write_memory(self, state: TrainingState) -> list[str]:
        """Restore everything that fits, and return messages about everything that starts anew."""
        memory = state.memory
        if memory is None:
            return [
                "a checkpoint has no training state, therefore episodes, learning rate, statistics,"
                " replay buffers and random generators start anew"
            ]
        fresh: list[str] = []
        if memory["learning_rates"] != self._learning_rates():
            fresh.append("learning rates start at the new setting")
            for name in [name for name in memory["agent"] if name.endswith("lr")]:
                del memory["agent"][name]
        self._write("stored", memory["agent"])
        self._rates_restored()
        if state.num_processes != current_group().size:
            fresh.append(
                f"{state.num_processes} process(es) wrote the state, {current_group().size} resume"
                " it, therefore episodes, replay buffers and random generators start anew"
            )
            return fresh
        if self.config.get("save_buffers", True) and any(self._attributes("stored_buffers")):
            if state.buffers is None:
                fresh.append("the replay buffers start empty because their file is missing")
            else:
                self._write("stored_buffers", state.buffers)
        if self._task is None or memory["task"] is None:
            fresh.append("the environment has no state to store, therefore episodes start anew")
        elif memory["task_settings"] == self._task_settings():
            self._write("stored_episodes", memory["episodes"])
            self._task.load_state_dict(memory["task"])
        else:
            fresh.append(
                "settings of the task, num_envs or horizon_length changed, therefore episodes start"
                " anew"
            )
        write_generators(memory["generators"])
        return fresh

    def _write(self, kind: str, stored: dict[str, Any]) -> None:
        for name, holder, attribute in self._attributes(kind):
            if name in stored:
                value = getattr(holder, attribute)
                written = write_state(value, stored[name], self.ppo_device)
                if written is not value:
                    setattr(holder, attribute, written)

    def _rates_restored(self) -> None:
        """Set the optimisers' learning rates to the restored ones."""
