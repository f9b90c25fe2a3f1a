"""Implements population based training as an observer of a training.

The rules for replacing policies are DexPBT's (Petrenko et al. 2023, arXiv:2305.12127), which
IsaacGymEnvs also uses.
"""

from __future__ import annotations

import logging
import math
import random
import statistics
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import torch
from rl_games.common.algo_observer import AlgoObserver
from torch import Tensor

from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from isaacgymenvs_lite.checkpoints.training_state import write_start
from isaacgymenvs_lite.config.pbt_settings import PBTSettings, mutable_values, read_pbt_settings
from isaacgymenvs_lite.env_interface import diverged_in
from isaacgymenvs_lite.errors import CheckpointError, ConfigError, UserError, one_line
from isaacgymenvs_lite.pbt.mutation import mutate
from isaacgymenvs_lite.pbt.restart import RestartRequest
from isaacgymenvs_lite.pbt.workspace import Record, Workspace

log = logging.getLogger(__name__)

KEY = "true_objective"
"""Key of the true objective (N,), which may differ from the reward, in a task's infos."""
# Probability that a policy which copies a better policy's weights also copies its settings.
_TAKE_SETTINGS = 0.5
# Share of the worst policies that are left out when the standard deviation of the objectives is
# computed, because one failed policy would dominate the standard deviation.
_OUTLIERS = 0.2


def run_suffix(tree: Mapping[str, Any]) -> str:
    """Return the suffix of a policy's run folders, which is '' without a population."""
    settings = read_pbt_settings(tree)
    return "" if settings is None else f"_pbt_{settings.policy_idx:02d}"


def first_mutation(tree: Mapping[str, Any], seed: int) -> dict[str, float]:
    """Return a dictionary from the paths of a policy's settings to the initially mutated values.

    The dictionary is empty without a population, or if an earlier process has begun the policy.
    """
    pbt = read_pbt_settings(tree)
    if pbt is None or _goes_on(tree):
        return {}
    former = mutable_values(tree, pbt)
    params = _mutated(former, pbt, _generator(seed, pbt, "start"))
    log.info("pbt: policy %d begins with %s", pbt.policy_idx, _changes(former, params))
    return params


def mutable_settings(tree: Mapping[str, Any]) -> dict[str, float]:
    """Map paths to the values of the mutable settings; return {} without a population."""
    pbt = read_pbt_settings(tree)
    return {} if pbt is None else mutable_values(tree, pbt)


@contextmanager
def population_of(
    tree: Mapping[str, Any], seed: int, train_dir: Path, decides: bool = True
) -> Iterator[PBTObserver | None]:
    """Join a population during a `with` statement, which gives the observer.

    Without a population the `with` statement gives None.

    Args:
        tree: the resolved tree.
        seed: seed of the training.
        train_dir: folder of all runs.
        decides: whether this is the main process of the policy, which uses the workspace.

    Raises:
        ConfigError: the workspace cannot be used, see `Workspace`.
    """
    pbt = read_pbt_settings(tree)
    if pbt is None:
        yield None
        return
    params = mutable_values(tree, pbt)
    workspace = Workspace(train_dir / pbt.workspace, pbt, dict(tree), params)
    observer = PBTObserver(pbt, workspace, params, seed, str(tree["task"]["name"]))
    observer.decides = decides
    with ExitStack() as opened:
        if decides:
            opened.enter_context(workspace).join(is_new=not _goes_on(tree))
        yield observer


class ObjectiveMeter:
    """Measures the objective of the policy, and its best value since the last comparison.

    The objective is the mean, over all environments, of `infos["true_objective"]` at the last step
    of an environment's last episode. If a task lacks this info, the objective is the mean reward of
    the last `games_to_track` episodes.
    """

    def __init__(self, algo: Any) -> None:
        self._algo = algo
        self._last: Tensor | None = None  # (N,) NaN until an environment's first episode ends
        self._best = -math.inf

    def process_infos(self, infos: dict[str, Any], done_indices: Tensor) -> None:
        """Store the objectives of the environments `done_indices` (n, 1), whose episodes ended."""
        rows = done_indices.flatten()
        if len(rows) == 0:
            return
        if KEY in infos:
            values = torch.as_tensor(infos[KEY])
            num_envs = self._algo.num_actors
            if values.shape != (num_envs,):
                raise ConfigError(
                    f"infos['{KEY}'] of the task has the shape {tuple(values.shape)}; population"
                    f" based training expects one number for each environment, ({num_envs},)"
                )
            if self._last is None:
                self._last = torch.full((num_envs,), math.nan, device=values.device)
            rows = rows.to(values.device)
            if (diverged := diverged_in(infos, values.device)) is not None:
                rows = rows[~diverged[rows]]  # a divergence is not the end of an episode
            self._last[rows] = values[rows].float()
        value = self.value
        if value is not None:
            self._best = max(self._best, value)

    @property
    def value(self) -> float | None:
        """The objective, or None before each environment has ended an episode."""
        if self._last is not None:
            mean = self._last.mean().item()
        elif self._algo.game_rewards.current_size >= self._algo.games_to_track:
            mean = float(self._algo.game_rewards.get_mean().flatten()[0])
        else:
            return None
        return mean if math.isfinite(mean) else None

    def end_interval(self, value: float) -> float:
        """Return the best of `value` and all values since the last call; forget all of them."""
        best, self._best = max(self._best, value), -math.inf
        return best


class PBTObserver(AlgoObserver):
    """Compares the policy with its population, and restarts the training with changed settings.

    Every `pbt.interval_steps` the policy writes its record and checkpoint into the workspace and
    reads the files of the other policies. If the policy is replaced, a `RestartRequest` ends
    rl_games' loop.

    If several processes train one policy (data-parallel), the main process decides, and all
    processes restart: they call `after_steps` at the same time, and `share` sends the decision. All
    processes need the main process' seed, so that they begin with the same settings.

    Attributes:
        decides: whether this is the main process of the policy.
        share: function that returns the main process' argument, the decision, in all processes.
        is_stopping: function that returns whether the training is about to end. Then it does not
            restart.
        check_settings: function that raises an error if a training would refuse the settings.
    """

    def __init__(
        self,
        settings: PBTSettings,
        workspace: Workspace,
        params: Mapping[str, float],
        seed: int,
        task: str,
    ) -> None:
        super().__init__()
        self._settings = settings
        self._workspace = workspace
        self._params = dict(params)
        self._seed, self._task = seed, task
        self._iteration: int | None = None
        self._first_frame = 0
        self.decides = True
        self.share: Callable[[RestartRequest | None], RestartRequest | None]
        self.share = lambda request: request
        self.is_stopping: Callable[[], bool] = lambda: False
        self.check_settings: Callable[[Mapping[str, float]], object] = lambda settings: None

    def after_init(self, algo: Any) -> None:
        """Store the agent."""
        self._algo = algo
        self._objective = ObjectiveMeter(algo)

    def process_infos(self, infos: dict[str, Any], done_indices: Tensor) -> None:
        """Pass the infos of the environments (n, 1) whose episodes ended to the meter."""
        self._objective.process_infos(infos, done_indices)

    def after_steps(self) -> None:
        """Compare policies after each interval; raise a `RestartRequest` to replace this policy."""
        request = self.share(self.decide() if self.decides else None)
        if request is not None:
            raise request

    def decide(self) -> RestartRequest | None:
        """Compare policies after each interval; return a request if this policy is replaced."""
        frame = self._algo.frame
        iteration = frame // self._settings.interval_steps
        if self._iteration is None:
            self._iteration, self._first_frame = iteration, frame
        objective = self._objective.value
        if iteration <= self._iteration or objective is None or self.is_stopping():
            return None
        self._iteration = iteration
        best = self._objective.end_interval(objective)
        try:
            population = self._exchange(iteration, objective)
        except OSError as error:
            log.warning("pbt: no comparison at frame %d (%s); training goes on", frame, error)
            return None
        settings = self._settings
        if frame - self._first_frame < settings.start_after or frame < settings.initial_delay:
            return None
        rng = _generator(self._seed, settings, iteration)
        while True:
            objectives = {index: record.true_objective for index, record in population.items()}
            donor = find_replacement(settings, objectives, best, rng)
            if donor is None:
                return None
            request = self._replaced_by(donor, population, rng)
            if request is not None or donor == settings.policy_idx:
                return request
            del population[donor]  # The donor's checkpoint is unusable; choose another policy.

    def _exchange(self, iteration: int, objective: float) -> dict[int, Record]:
        """Write this policy's record; return the newest record of each policy."""
        algo, workspace = self._algo, self._workspace
        record = Record(
            iteration=iteration,
            true_objective=objective,
            frame=algo.frame,
            epoch=max(0, algo.epoch_num - 1),  # epoch_num includes the running epoch
            experiment_name=algo.experiment_name,
            params=self._params,
        )
        workspace.write(record, {**algo.get_full_state_weights(), "epoch": record.epoch})
        population = {**workspace.newest_records(iteration), self._settings.policy_idx: record}
        leader = self._leader(population)
        workspace.keep_best(leader, population[leader], self._task)
        for path, value in self._params.items():
            algo.writer.add_scalar(f"pbt/{path}", value, algo.frame)
        best = population[leader].true_objective
        algo.writer.add_scalar("pbt/00_best_objective", best, algo.frame)
        log.info(
            "pbt: policy %d, frame %d: objective %.4g, the best %.4g of policy %d (%d of %d known)",
            *(self._settings.policy_idx, algo.frame, objective, best, leader),
            *(len(population), self._settings.num_policies),
        )
        return population

    def _leader(self, population: dict[int, Record]) -> int:
        """Remove policies with unusable checkpoints from `population`; return the best policy."""
        while True:
            leader = max(population, key=lambda index: population[index].true_objective)
            if leader == self._settings.policy_idx:
                return leader
            try:
                self._state_of(leader, population[leader])
            except (OSError, CheckpointError) as error:
                log.warning("pbt: policy %d is left out of the comparison (%s)", leader, error)
                del population[leader]
            else:
                return leader

    def _state_of(self, policy: int, record: Record) -> dict[str, Any]:
        """Return another policy's checkpoint after checking that this policy can load it."""
        file = self._workspace.checkpoint_of(policy, record)
        state = load_checkpoint(file)
        # The agents of a fork of this package may lack this method.
        getattr(self._algo, "check_fits", lambda *_: None)(state, f"checkpoint={file}")
        return state

    def _replaced_by(
        self, donor: int, population: Mapping[int, Record], rng: random.Random
    ) -> RestartRequest | None:
        """Return a request to restart, or None if the checkpoint or the settings cannot be used.

        The checkpoint and the settings are checked before any file is written, so that a failure
        does not change this policy.
        """
        own, algo = self._settings.policy_idx, self._algo
        params = self._params
        if rng.random() < _TAKE_SETTINGS:
            params = {path: population[donor].params[path] for path in params}
        params = _mutated(params, self._settings, rng)
        run = Path(algo.experiment_dir)
        try:
            state = self._state_of(donor, population[donor])
            try:
                self.check_settings(params)
            except Exception as error:  # A user's task may raise errors of any type.
                texts = ", ".join(f"{path}={value:.4g}" for path, value in params.items())
                raise ConfigError(f"{one_line(error)}; settings of {donor}: {texts}") from error
            # The run keeps its frame counter; only the networks come from the other policy.
            state |= {"frame": algo.frame, "epoch": population[own].epoch}
            if donor != own:
                state.pop("last_mean_rewards", None)
            file = write_start(run, state)
        except (OSError, UserError) as error:
            log.warning(
                "pbt: policy %d does not go on as policy %d (%s); training goes on",
                *(own, donor, error),
            )
            return None
        log.info(
            "pbt: policy %d (objective %.4g) goes on with the weights of policy %d (%.4g), and %s",
            *(own, population[own].true_objective, donor, population[donor].true_objective),
            _changes(self._params, params),
        )
        changed = {
            **params,
            "checkpoint": str(file.absolute()),
            "full_experiment_name": algo.experiment_name,
            "pbt_restart": True,
        }
        return RestartRequest(changed, run)


def find_replacement(
    settings: PBTSettings,
    objectives: Mapping[int, float],
    best_of_interval: float,
    rng: random.Random,
) -> int | None:
    """Return the policy whose weights `settings.policy_idx` should copy, or None for no change.

    A policy among the worst always gets new settings. It copies the weights of one of the best
    policies only if their objectives differ clearly; otherwise the function returns
    `settings.policy_idx`, and the weights stay.

    Args:
        settings: settings of the population.
        objectives: maps the index of each known policy to its objective.
        best_of_interval: best objective of this policy since the last comparison.
        rng: generator that chooses among the best policies.
    """
    own, total = settings.policy_idx, settings.num_policies
    ranked = sorted(objectives, key=lambda index: (-objectives[index], index))
    best = ranked[: math.ceil(settings.replace_fraction_best * total)]
    if not settings.dbg_mode:
        # A policy whose objective is unknown ranks last.
        unknown = [index for index in range(total) if index not in objectives]
        worst = [*ranked, *unknown][-math.ceil(settings.replace_fraction_worst * total) :]
        reached = min(objectives[index] for index in best)
        if (
            own not in worst
            or best_of_interval >= reached
            or len(objectives) < num_needed(settings.num_policies)
        ):
            return None
    donor = rng.choice(best)
    lead = objectives[donor] - objectives[own]
    values = sorted(objectives.values())
    spread = statistics.pstdev(values[math.floor(_OUTLIERS * len(values)) :])
    by_spread = settings.replace_threshold_frac_std * spread
    by_size = settings.replace_threshold_frac_absolute * abs(objectives[donor])
    return donor if lead > by_spread and lead > by_size else own


def num_needed(num_policies: int) -> int:
    """Return how many policies must have written a record before a policy is replaced.

    The number is more than half of the policies, and at least three as in IsaacGymEnvs. In a
    population of two policies the number is two, although IsaacGymEnvs never replaces them.
    """
    return min(num_policies, max(2, num_policies // 2) + 1)


def _goes_on(tree: Mapping[str, Any]) -> bool:
    """Return whether an earlier process has begun the policy."""
    return any(tree.get(key) for key in ("pbt_restart", "resume"))


def _generator(seed: int, settings: PBTSettings, when: int | str) -> random.Random:
    return random.Random(f"{seed} {settings.policy_idx} {when}")


def _mutated(
    params: Mapping[str, float], settings: PBTSettings, rng: random.Random
) -> dict[str, float]:
    limits = (settings.mutation_rate, settings.change_min, settings.change_max)
    return mutate(params, settings.mutation, *limits, rng)


def _changes(former: Mapping[str, float], params: Mapping[str, float]) -> str:
    """Describe the changed settings in a text for the log."""
    changed = {path for path in params if params[path] != former[path]}
    texts = [f"{path} {former[path]:.4g} -> {params[path]:.4g}" for path in sorted(changed)]
    return ", ".join(texts) or "the settings as they are"
