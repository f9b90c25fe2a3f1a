"""Population based training as an observer of a training."""

from __future__ import annotations

import logging
import random
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from rl_games.common.algo_observer import AlgoObserver
from torch import Tensor

from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from isaacgymenvs_lite.checkpoints.training_state import write_start
from isaacgymenvs_lite.config.pbt_settings import PBTSettings, mutable_values, read_pbt_settings
from isaacgymenvs_lite.errors import CheckpointError, ConfigError, UserError, one_line
from isaacgymenvs_lite.pbt.mutation import mutate
from isaacgymenvs_lite.pbt.objective import ObjectiveMeter
from isaacgymenvs_lite.pbt.population import find_replacement
from isaacgymenvs_lite.pbt.restart import RestartRequest
from isaacgymenvs_lite.pbt.workspace import Record, Workspace

log = logging.getLogger(__name__)

# A policy that gets the weights of a better one keeps its own settings as often as it takes those.
_TAKE_SETTINGS = 0.5


def run_suffix(tree: Mapping[str, Any]) -> str:
    """Return what the run folders of a policy have in their names; '' without a population."""
    settings = read_pbt_settings(tree)
    return "" if settings is None else f"_pbt_{settings.policy_idx:02d}"


def first_mutation(tree: Mapping[str, Any], seed: int) -> dict[str, float]:
    """Return settings, by their paths, with which a policy begins to differ from the others.

    Args:
        tree: resolved.
        seed: of the training.

    Returns:
        Nothing without a population, or if the policy has begun before this process.
    """
    pbt = read_pbt_settings(tree)
    if pbt is None or _goes_on(tree):
        return {}
    former = mutable_values(tree, pbt)
    params = _mutated(former, pbt, _generator(seed, pbt, "start"))
    log.info("pbt: policy %d begins with %s", pbt.policy_idx, _changes(former, params))
    return params


def mutable_settings(tree: Mapping[str, Any]) -> dict[str, float]:
    """Return the settings that mutate, numbers by path; none without a population."""
    pbt = read_pbt_settings(tree)
    return {} if pbt is None else mutable_values(tree, pbt)


@contextmanager
def population_of(
    tree: Mapping[str, Any], seed: int, train_dir: Path, decides: bool = True
) -> Iterator[PBTObserver | None]:
    """Join the population of a tree, and give its observer; None without one.

    Args:
        tree: resolved.
        seed: of the training.
        train_dir: folder of the runs.
        decides: False of all but the first of several processes that train one policy: these
            leave the workspace alone.

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


class PBTObserver(AlgoObserver):
    """Compares the policy with its population, and ends the training that should go on changed.

    At every `pbt.interval_steps` the policy writes record and checkpoint into the workspace and
    reads the others' files. If it is replaced, a `RestartRequest` leaves rl_games' loop.

    Of several processes that train one policy (data-parallel), the first decides, and all of them
    restart: `after_steps` is called in each at the same place, and `share` sends the decision. All
    of them need the seed of the first, so that they begin with the same settings.

    Args:
        settings: of the population.
        workspace: of this policy.
        params: settings that mutate, numbers by path.
        seed: of the training; with the policy's index it decides all mutations.
        task: its name.

    Attributes:
        decides: whether this process decides; False of all but the first of a policy.
        share: receives the first process' decision (None elsewhere) and returns it in all.
        is_stopping: returns whether the training is about to end, so that nothing restarts.
        check_settings: raises if a training would refuse these numbers by key path.
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
        self.share: Callable[[RestartRequest | None], RestartRequest | None] = _as_it_is
        self.is_stopping: Callable[[], bool] = lambda: False
        self.check_settings: Callable[[Mapping[str, float]], object] = lambda settings: None

    def after_init(self, algo: Any) -> None:
        """Store the agent."""
        self._algo = algo
        self._objective = ObjectiveMeter(algo)

    def process_infos(self, infos: dict[str, Any], done_indices: Tensor) -> None:
        """Measure the objective of the environments (n, 1) whose episodes ended."""
        self._objective.process_infos(infos, done_indices)

    def after_steps(self) -> None:
        """Compare if it is time.

        Raises:
            RestartRequest: the policy is replaced.
        """
        request = self.share(self.decide() if self.decides else None)
        if request is not None:
            self.act(request)

    def act(self, request: RestartRequest) -> None:
        """Leave rl_games' loop.

        Raises:
            RestartRequest: always.
        """
        raise request

    # --- deciding --------------------------------------------------------------------------

    def decide(self) -> RestartRequest | None:
        """Compare if it is time; return what to restart with if the policy is replaced."""
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
            del population[donor]  # broken: choose again without it

    def _exchange(self, iteration: int, objective: float) -> dict[int, Record]:
        """Write this policy's record; return the newest one of each policy.

        Raises:
            OSError: the workspace cannot be written.
        """
        algo, workspace = self._algo, self._workspace
        record = Record(
            iteration=iteration,
            true_objective=objective,
            frame=algo.frame,
            epoch=max(0, algo.epoch_num - 1),  # rl_games has counted the one that goes on
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
        """Return the best policy; remove those whose checkpoint cannot be used."""
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
        """Return the checkpoint of a policy.

        Raises:
            CheckpointError: this policy could not go on with it.
        """
        file = self._workspace.checkpoint_of(policy, record)
        state = load_checkpoint(file)
        # An agent of a fork's own may have no such check.
        getattr(self._algo, "check_fits", lambda *_: None)(state, f"checkpoint={file}")
        return state

    def _replaced_by(
        self, donor: int, population: Mapping[int, Record], rng: random.Random
    ) -> RestartRequest | None:
        """Return what to restart with; None if checkpoint or settings cannot be used.

        Nothing is written before both are found usable: the policy's own state stays.
        """
        own, algo = self._settings.policy_idx, self._algo
        params = self._params
        if rng.random() < _TAKE_SETTINGS:
            params = {path: population[donor].params[path] for path in params}
        params = _mutated(params, self._settings, rng)
        run = Path(algo.experiment_dir)
        try:
            state = self._state_of(donor, population[donor])
            self._check(params, donor)
            # The run goes on where it is; only the networks are another policy's.
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
        return RestartRequest(
            {
                **params,
                "checkpoint": str(file.absolute()),
                "full_experiment_name": algo.experiment_name,
                "pbt_restart": True,
            },
            run,
        )

    def _check(self, params: Mapping[str, float], donor: int) -> None:
        try:
            self.check_settings(params)
        except Exception as error:  # a task of the user's own may raise anything
            texts = ", ".join(f"{path}={value:.4g}" for path, value in params.items())
            raise ConfigError(f"{one_line(error)}; settings of policy {donor}: {texts}") from error


def _goes_on(tree: Mapping[str, Any]) -> bool:
    """Return whether the policy has begun before this process."""
    return any(tree.get(key) for key in ("pbt_restart", "resume"))


def _generator(seed: int, settings: PBTSettings, when: int | str) -> random.Random:
    return random.Random(f"{seed} {settings.policy_idx} {when}")


def _mutated(
    params: Mapping[str, float], settings: PBTSettings, rng: random.Random
) -> dict[str, float]:
    limits = (settings.mutation_rate, settings.change_min, settings.change_max)
    return mutate(params, settings.mutation, *limits, rng)


def _changes(former: Mapping[str, float], params: Mapping[str, float]) -> str:
    """Return the settings that changed in words."""
    changed = {path for path in params if params[path] != former[path]}
    texts = [f"{path} {former[path]:.4g} -> {params[path]:.4g}" for path in sorted(changed)]
    return ", ".join(texts) or "the settings as they are"


def _as_it_is(request: RestartRequest | None) -> RestartRequest | None:
    return request
