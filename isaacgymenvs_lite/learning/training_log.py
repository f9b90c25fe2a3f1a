"""What CommonAgent collects in an epoch and writes to TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from rl_games.algos_torch import torch_ext
from torch import Tensor

from isaacgymenvs_lite.learning.safeguards import PPOSafeguards


class TrainingLog(PPOSafeguards):
    """Statistics of finished episodes, and scalars of an agent's minibatches and epochs.

    Attributes:
        scalars: what an agent collects -> its name in TensorBoard.
    """

    scalars: ClassVar[dict[str, str]] = {"actor_clip_frac": "info/clip_frac"}

    writer: Any
    _train_info: dict[str, list[Tensor]]
    _epoch_info: dict[str, Any]

    def _track_episodes(
        self, rewards: Tensor, shaped_rewards: Tensor, infos: dict[str, Any]
    ) -> None:
        """Feed rl_games' meters of finished episodes and the observers."""
        self.current_rewards += rewards
        self.current_shaped_rewards += shaped_rewards
        self.current_lengths += 1
        done_indices = self.dones.nonzero(as_tuple=False)[:: self.num_agents]
        self.game_rewards.update(self.current_rewards[done_indices])
        self.game_shaped_rewards.update(self.current_shaped_rewards[done_indices])
        self.game_lengths.update(self.current_lengths[done_indices])
        self.algo_observer.process_infos(infos, done_indices)
        going_on = (1.0 - self.dones.float()).unsqueeze(1)
        self.current_rewards *= going_on
        self.current_shaped_rewards *= going_on
        self.current_lengths *= going_on.squeeze(1)

    def _collect(self, values: dict[str, Tensor]) -> None:
        """Keep values of a minibatch or of an epoch; `_log_train_info` writes their means."""
        for name, value in values.items():
            self._train_info.setdefault(name, []).append(value)

    def train_info_means(self) -> dict[str, float]:
        """Return the epoch means of all collected scalars."""
        return {
            name: torch_ext.mean_list(values).item() for name, values in self._train_info.items()
        }

    def write_stats(self, total_time: float, epoch_num: int, *args: Any) -> None:
        """Write rl_games' scalars and those that IsaacGymEnvs' CommonAgent adds."""
        (step_time, play_time, update_time, *_rest) = args
        frame, scaled_time, _scaled_play_time, curr_frames = args[-4:]
        writer = self.writer
        writer.add_scalar("performance/total_fps", curr_frames / scaled_time, frame)
        writer.add_scalar("performance/update_time", update_time, frame)
        writer.add_scalar("performance/play_time", play_time, frame)
        self._log_train_info(self._epoch_info, frame)
        if self.game_rewards.current_size > 0:
            mean_length = self.game_lengths.get_mean().item()
            mean_reward = self.game_rewards.get_mean()[0].item()
            writer.add_scalar("rewards/frame", mean_reward, frame)
            writer.add_scalar("episode_lengths/frame", mean_length, frame)
        super().write_stats(total_time, epoch_num, step_time, play_time, update_time, *_rest)

    def _check_losses(self, losses: Mapping[str, list[Tensor]]) -> None:
        """As PPO; all that an agent has collected, which `losses` are a part of."""
        del losses
        super()._check_losses(self._train_info)

    def _log_train_info(self, train_info: dict[str, Any], frame: int) -> None:
        """Write the scalars of an epoch.

        Args:
            train_info: lists with one value for each minibatch, by the names of `train_result`,
                and what `_record_train_batch_info` added.
            frame: environment steps before the epoch.
        """
        for name, tag in self.scalars.items():
            if name in train_info:
                mean = torch_ext.mean_list(train_info[name]).item()
                self.writer.add_scalar(tag, mean, frame)
