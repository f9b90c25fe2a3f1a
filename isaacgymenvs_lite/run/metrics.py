"""The metrics of an epoch, read from the agent once for all observers that show or check them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rl_games.algos_torch.torch_ext import AverageMeter
from rl_games.common.algo_observer import AlgoObserver
from torch import Tensor

from isaacgymenvs_lite.env_interface import diverged_in
from isaacgymenvs_lite.utils.state import Stateful


@dataclass(frozen=True)
class EpochMetrics:
    """What is measured in an epoch; None where the agent or the task does not have it.

    Attributes:
        epoch: number of the epoch.
        frame: environment steps trained before it, including those before a resumed run.
        episode_steps: mean length of the last episodes in control steps.
        episode_reward: mean sum of the task's rewards of the last episodes.
        fall_rate: share of the last episodes that ended by a fall, 0 to 1; of a task without
            `terminate`: that ended before the time limit.
        off_clip_rate: share of the last episodes that ended because the motion left its clip.
        train_info: `CommonAgent.train_info_means`; empty for rl_games' own agents.
    """

    epoch: int
    frame: int
    episode_steps: float | None = None
    episode_reward: float | None = None
    fall_rate: float | None = None
    off_clip_rate: float | None = None
    train_info: Mapping[str, float] = field(default_factory=dict)

    @property
    def early_end_rate(self) -> float | None:
        """Share of the last episodes that fell or left their clip."""
        return None if self.fall_rate is None else self.fall_rate + (self.off_clip_rate or 0.0)

    @property
    def style_reward(self) -> float | None:
        """Mean style reward per step."""
        return self.train_info.get("disc_reward_mean")

    @property
    def disc_accuracy(self) -> float | None:
        """Share of samples of policy and clips that the discriminator tells right: 0.5 is guessing.

        Both kinds count alike.
        """
        info = self.train_info
        if "disc_agent_acc" not in info or "disc_demo_acc" not in info:
            return None
        return 0.5 * (info["disc_agent_acc"] + info["disc_demo_acc"])


class MetricsObserver(Stateful, AlgoObserver):
    """Stores the newest `EpochMetrics` and writes three of them, such as `info/fall_rate`.

    Falls are averaged over the same last episodes as rl_games' mean length and reward
    (`games_to_track`). It must come before the observers that read `latest`.
    """

    latest: EpochMetrics | None = None
    best_reward: float | None = None
    stored = ("best_reward",)

    def after_init(self, algo: Any) -> None:
        """Store the agent."""
        self._algo = algo
        self._falls = AverageMeter(1, algo.games_to_track).to(algo.ppo_device)
        self._off_clip = AverageMeter(1, algo.games_to_track).to(algo.ppo_device)

    def state_dict(self) -> dict[str, Any]:
        """Return the state, the counted episodes included."""
        meters = [[each.mean.cpu(), each.current_size] for each in (self._falls, self._off_clip)]
        return {**super().state_dict(), "meters": meters}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state."""
        super().load_state_dict({n: part for n, part in state.items() if n != "meters"})
        for meter, (mean, size) in zip((self._falls, self._off_clip), state["meters"], strict=True):
            meter.mean.copy_(mean)
            meter.current_size = int(size)

    def process_infos(self, infos: dict[str, Any], done_indices: Tensor) -> None:
        """Count how the episodes of `done_indices` (n, 1) ended."""
        rows = done_indices.flatten()
        if (diverged := diverged_in(infos, rows.device)) is not None:
            rows = rows[~diverged[rows]]  # cut off: neither a fall nor none
        off_clip = infos["off_clip"][rows].bool() if "off_clip" in infos else None
        if "terminate" in infos:
            fell = infos["terminate"][rows].bool()
            self._falls.update((fell if off_clip is None else fell & ~off_clip).unsqueeze(1))
        elif "time_outs" in infos:
            self._falls.update(~infos["time_outs"][rows].bool().unsqueeze(1))
        if off_clip is not None:
            self._off_clip.update(off_clip.unsqueeze(1))

    def after_clear_stats(self) -> None:
        """Drop the episodes, as the agent's meters just did."""
        self._falls.clear()
        self._off_clip.clear()

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        """Read the metrics of the epoch."""
        algo = self._algo
        has_episodes = algo.game_lengths.current_size > 0
        self.latest = latest = EpochMetrics(
            epoch=epoch_num,
            frame=frame,
            episode_steps=algo.game_lengths.mean.item() if has_episodes else None,
            episode_reward=algo.game_rewards.mean.flatten()[0].item() if has_episodes else None,
            fall_rate=_mean(self._falls),
            off_clip_rate=_mean(self._off_clip),
            train_info=algo.train_info_means() if hasattr(algo, "train_info_means") else {},
        )
        if latest.episode_reward is not None:
            best = self.best_reward
            self.best_reward = max(latest.episode_reward, -math.inf if best is None else best)
        for tag, value in (
            ("info/fall_rate", latest.fall_rate),
            ("info/off_clip_rate", latest.off_clip_rate),
            ("info/disc_acc", latest.disc_accuracy),
        ):
            if value is not None:
                algo.writer.add_scalar(tag, value, frame)


def _mean(meter: AverageMeter) -> float | None:
    return meter.mean.item() if meter.current_size > 0 else None
