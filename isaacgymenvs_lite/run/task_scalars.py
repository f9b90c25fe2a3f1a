"""Writes the scalars of a task's infos to TensorBoard."""

from __future__ import annotations

from typing import Any

import torch
from rl_games.common.algo_observer import AlgoObserver
from torch import Tensor

from isaacgymenvs_lite.env_interface import diverged_in, reports_divergence
from isaacgymenvs_lite.utils.state import Stateful


class TaskScalarsObserver(Stateful, AlgoObserver):
    """Writes a task's infos to TensorBoard, with the tags of IsaacGymEnvs' RLGPUAlgoObserver.

    `Episode/<key>`: means of infos["episode"]; `episode_cumulative/<key>` (and _min, _max): sums
    of infos["episode_cumulative"] over an episode; every scalar in infos, nested keys joined by
    "/", as `<key>/frame`, `/iter`, `/time`. Also `sim/diverged`: how many simulations diverged in
    the epoch, of infos["diverged"] (N,) bool; their episodes are left out of all means. And
    `reward_terms/<name>`: the terms of a reward that has several, as means over environments and
    steps of the epoch; a high level reads the last of the steps under one of its actions.
    """

    stored = ("_running", "_finished")

    def after_init(self, algo: Any) -> None:
        """Store the agent, and begin without values."""
        self._algo = algo
        self._episode_infos: list[dict[str, Any]] = []
        self._scalars: dict[str, float] = {}
        self._running: dict[str, Tensor] = {}
        self._finished: dict[str, list[float]] = {}
        self._diverged: int | None = None
        self._terms: dict[str, Tensor] = {}
        self._steps = 0

    def process_infos(self, infos: dict[str, Any], done_indices: Tensor) -> None:
        """Collect the values of a step."""
        diverged = diverged_in(infos, done_indices.device)
        if reports_divergence(infos.get("diverged")):
            found = 0 if diverged is None else int(diverged.sum())
            self._diverged = (self._diverged or 0) + found
        if "episode" in infos:
            self._episode_infos.append(infos["episode"])
        if "episode_cumulative" in infos:
            self._accumulate(infos["episode_cumulative"], done_indices.flatten(), diverged)
        self._scalars = dict(_flat_scalars(infos))
        task = getattr(getattr(self._algo, "vec_env", None), "env", None)
        terms = getattr(task, "reward_terms", {})
        if len(terms) > 1:  # one is the reward itself
            self._steps += 1
            for name, term in terms.items():
                self._terms[name] = self._terms.get(name, 0.0) + term.mean()

    def _accumulate(
        self, values: dict[str, Tensor], done_ids: Tensor, diverged: Tensor | None
    ) -> None:
        counted = done_ids
        if diverged is not None:
            counted = done_ids[~diverged[done_ids]]
        for key, value in values.items():
            total = self._running.setdefault(key, torch.zeros_like(value))
            total += value
            finished = self._finished.setdefault(key, [])
            finished += total[counted].tolist()
            del finished[: -self._algo.games_to_track]
            total[done_ids] = 0

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        """Write what was collected."""
        writer = self._algo.writer
        if self._diverged is not None:
            writer.add_scalar("sim/diverged", self._diverged, frame)
            self._diverged = 0
        for name, sum_of_means in self._terms.items():
            writer.add_scalar(f"reward_terms/{name}", float(sum_of_means) / self._steps, frame)
        self._terms.clear()
        self._steps = 0
        if self._episode_infos:
            for key in self._episode_infos[0]:
                values = [torch.as_tensor(i[key]).float().flatten() for i in self._episode_infos]
                writer.add_scalar(f"Episode/{key}", torch.cat(values).mean().item(), epoch_num)
            self._episode_infos.clear()
        for key, finished in self._finished.items():
            if finished:
                mean = sum(finished) / len(finished)
                writer.add_scalar(f"episode_cumulative/{key}", mean, frame)
                writer.add_scalar(f"episode_cumulative_min/{key}_min", min(finished), frame)
                writer.add_scalar(f"episode_cumulative_max/{key}_max", max(finished), frame)
        for key, value in self._scalars.items():
            writer.add_scalar(f"{key}/frame", value, frame)
            writer.add_scalar(f"{key}/iter", value, epoch_num)
            writer.add_scalar(f"{key}/time", value, total_time)


def _flat_scalars(infos: dict[str, Any], prefix: str = "") -> list[tuple[str, float]]:
    found: list[tuple[str, float]] = []
    for key, value in infos.items():
        if key in ("episode", "episode_cumulative"):
            continue
        if isinstance(value, dict):
            found += _flat_scalars(value, f"{prefix}{key}/")
        elif isinstance(value, (int, float)) or (isinstance(value, Tensor) and value.ndim == 0):
            found.append((f"{prefix}{key}", float(value)))
    return found
