"""Trains or plays the agent of a composed configuration.

cfg = compose(["task=HumanoidAMP", "checkpoint=walk", "test=True"])
run(cfg)                            # like train.py
with load_player(cfg) as player:    # a policy and its task, for your own loop
    actions = player.act(player.env.reset())
"""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import logging
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf, open_dict
from rl_games.common.algo_observer import AlgoObserver

from isaacgymenvs_lite.checkpoints import files as checkpoints
from isaacgymenvs_lite.checkpoints.training_state import run_of_file
from isaacgymenvs_lite.config.launch import CheckedConfig, read_config, resolve_seed
from isaacgymenvs_lite.config.resolvers import forbidden_resolver
from isaacgymenvs_lite.config.run_names import (
    DEFAULT_TRAIN_DIR,
    TRAIN_DIR,
    read_run_name,
    run_name_of,
)
from isaacgymenvs_lite.config.train_params import (
    check_env_name,
    checkpoint_in_file,
    prepare_train_params,
)
from isaacgymenvs_lite.distributed import mark_run, started_by_torchrun
from isaacgymenvs_lite.distributed.group import ProcessGroup, joined_group
from isaacgymenvs_lite.env_factory import make_from_config, seed_everything, torch_settings_kept
from isaacgymenvs_lite.errors import (
    CheckpointError,
    ConfigError,
    NotFiniteError,
    UserError,
    one_line,
)
from isaacgymenvs_lite.pbt.observer import (
    first_mutation,
    mutable_settings,
    population_of,
    run_suffix,
)
from isaacgymenvs_lite.pbt.restart import RestartRequest
from isaacgymenvs_lite.run.divergence import DivergenceFiles
from isaacgymenvs_lite.run.folder import RunFolder, run_of_checkpoint
from isaacgymenvs_lite.run.measurement import MeasurementObserver
from isaacgymenvs_lite.run.memory import check_training_memory
from isaacgymenvs_lite.run.observers import POSE_ERROR, TrainingObservers, objective_of
from isaacgymenvs_lite.run.stop_request import StopRequest
from isaacgymenvs_lite.schema import leaves, select
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.typed_command import TypedCommand, package_command
from isaacgymenvs_lite.utils.precision import resolve_mixed_precision
from isaacgymenvs_lite.utils.threads import thread_count
from isaacgymenvs_lite.viewers.start import Viewers
from isaacgymenvs_lite.viewers.window import WindowClosedError

log = logging.getLogger(__name__)
_rl_games_log = logging.getLogger("rl_games")

_DEFAULT_IMITATION_FREQUENCY = 50
_PRECISION = "train.params.config.mixed_precision"
# Processes that train together need the same packages and the same settings, except for the
# settings in _OF_MACHINES.
_SAME_VERSIONS = ("isaacgymenvs_lite", "rl_games", "torch", "mujoco")
_OF_MACHINES = ("rl_device", "sim_device", "graphics_device_id", "num_threads")
# Settings of the processes that are not the main process: they show nothing and upload nothing.
_QUIET = {"headless": True, "viewer": "", "capture_video": False, "wandb_activate": False}
_MEASURED_EPISODES = 16
_MEASUREMENTS = 20
# A task without reference motions is not measured if its episodes may have more control steps. A
# measurement of 16 episodes of Anymal, with 2,500 steps each, takes 4 s.
_LONGEST_MEASURED = 10_000


def run(
    cfg: DictConfig | CheckedConfig,
    command: TypedCommand | None = None,
    *,
    stop: StopRequest | None = None,
    direction: str = "",
) -> float | None:
    """Train the agent of a composed tree (`test=False`), or play its policy (`test=True`).

    Args:
        cfg: the tree, or the result of `read_config`.
        command: the command line of the tree, for hints in the log; None if a program composed the
            tree.
        stop: tells the caller whether the user has ended the training.
        direction: the direction of a study, `minimize` or `maximize`, or '' without a study.

    Returns:
        The result of `train` or `play`.

    Raises:
        UserError: the user made a mistake; nothing was trained.
        RestartRequest: the training must continue in a new process, see `train`.
    """
    config = _checked(cfg)
    if config.settings.test:
        return play(config, direction=direction)
    return train(config, command, stop=stop, direction=direction)


@torch_settings_kept()
def train(
    cfg: DictConfig | CheckedConfig,
    command: TypedCommand | None = None,
    *,
    stop: StopRequest | None = None,
    direction: str = "",
) -> float | None:
    """Train the agent of a composed tree in a new run folder; `run` describes the arguments.

    Returns:
        The value with which runs are compared, see `Objective`: the best pose error in m (lower is
        better) or the best mean reward (higher is better). The value is None if no episode has
        ended.

    Raises:
        UserError: the user made a mistake. The run folder is removed unless the training has begun
            (`NotFiniteError`, or a last checkpoint that cannot be written).
        KeyboardInterrupt: the user ended the training with a second Ctrl-C or SIGTERM
            (`StoppedAtOnceError`); a checkpoint was saved if that was possible.
        RestartRequest: the training of a population's policy must continue with other settings in a
            new process, see `pbt.restart.start_again`.
    """
    config, stop = _checked(cfg), stop or StopRequest()
    joined = _joined_processes(config)
    with _memory_errors_explained(config), joined as group, ExitStack() as stack:
        launch = _read_launch_together(config, group, stack)
        make_task = stack.enter_context(_open_tasks(launch))
        # Everything that may raise a UserError is made before the run folder.
        with group.together():
            population = population_of(
                launch.tree, launch.seed, launch.folder.train_dir, decides=group.is_main
            )
            pbt = stack.enter_context(population)
            viewers = Viewers(launch.settings)
            task = make_task(launch.num_envs)
            params = _read_params(launch, task)
            check_training_memory(params, task, launch.num_envs)
            params["config"]["print_stats"] = False
            measurement = _measurement_observer(params["config"], task, make_task)
            has_clips = hasattr(task, "motion_lib")
            objective = objective_of(params["config"], has_clips and measurement is not None)
            objective.check_direction(direction, launch.task_name)
            observers = TrainingObservers(
                launch, launch.folder.name, measurement, task.max_episode_length, stop, pbt
            )
            if pbt is not None:
                pbt.is_stopping = lambda: stop.requested
                pbt.share = lambda request: RestartRequest.of(
                    group.from_main(request and request.content)
                )
                pbt.check_settings = functools.partial(_check_settings, launch, task)
        with group.together():
            if group.is_main:
                launch.folder.create(_stored_config(launch))
                _log_opening(launch, has_clips)
                if objective is POSE_ERROR:
                    log.info(
                        "the style reward falls at first, while the discriminator learns; longer"
                        " episodes and a smaller pose error show that the policy learns"
                    )
        if group.size > 1:
            sizes = f"{group.size} ranks x {launch.num_envs} environments"
            log.info("%s, %d thread(s) each", sizes, params["torch_threads"])
        task.listeners.append(DivergenceFiles(task, launch.folder.path, group.rank))
        observers.begin = functools.partial(_begin, launch.folder)
        measures_end = group.is_main and (objective is POSE_ERROR or observers.chooses_best)

        def run_agent() -> None:
            viewers.start(task, launch.folder.path, stop.request)
            with stop, _output_to_log(), group.lost_peers_explained():
                runner = _load_runner(params, task, observers)
                runner.run({"train": True, "play": False, **launch.overrides})
                if measures_end and not stop.requested:
                    observers.evaluate_end()

        try:
            interrupt = _guarded(run_agent, observers, launch, group, stop)
        finally:
            observers.close_log()
            viewers.close()  # before wandb, which uploads the last videos
            observers.close_wandb()
        best = None
        if group.is_main:
            # rl_games does not write a best checkpoint in the first `save_best_after` epochs.
            if not launch.checkpoint_file().exists():
                _save(observers.agent, launch)
            best = observers.best(objective)
            command = command or TypedCommand()
            _report_end(launch, command, group, stop.requested, observers.chooses_best)
        if interrupt is not None:
            raise interrupt
        if launch.folder.save_failed:
            raise _unsaved(launch.folder)
        return best


def _guarded(
    run_agent: Callable[[], None],
    observers: TrainingObservers,
    launch: _Launch,
    group: ProcessGroup,
    stop: StopRequest,
) -> KeyboardInterrupt | None:
    """Train until the end, or save a checkpoint when the user ends the training.

    The exception of a second Ctrl-C is returned, so that the caller can close everything before
    raising this exception.
    """
    try:
        run_agent()
    except NotFiniteError:
        raise  # the run folder stays, because its curves show the cause
    except UserError as error:
        launch.folder.remove_if_unused()
        if not getattr(observers.agent, "has_joined", False):
            group.fail_together(error)
        raise
    except RestartRequest:
        if not stop.requested:
            raise
        _save(observers.agent, launch, "_interrupted")  # the user has ended the training
    except KeyboardInterrupt as error:
        log.warning("stopped at once")
        _save(observers.agent, launch, "_interrupted")
        launch.folder.remove_if_unused()
        return error
    return None


@torch_settings_kept()
def play(cfg: DictConfig | CheckedConfig, *, direction: str = "") -> float | None:
    """Play the policy of a composed tree's checkpoint and log its results; see `run`.

    Returns:
        The pose error in m or the mean reward of the episodes, the same quantity that `train`
        returns for this policy. The result is None if the window was closed before a measurement or
        if the player belongs to another project.
    """
    launch = _read_launch(_checked(cfg))
    with (
        _memory_errors_explained(launch),
        _open_tasks(launch) as make_task,
        Viewers(launch.settings) as viewers,
    ):
        player = _make_player(launch, make_task(launch.num_envs))
        objective = objective_of(player.config, hasattr(player.env, "motion_lib"))
        objective.check_direction(direction, launch.task_name)
        folder = run_of_checkpoint(launch.checkpoint) or launch.folder.path
        stamp = Path(launch.folder.name).name.removeprefix(launch.name)

        def end() -> None:
            raise WindowClosedError

        viewers.start(player.env, folder, end, f"play{stamp}")
        with contextlib.suppress(WindowClosedError), _output_to_log():
            player.run()
    result = getattr(player, "result", None)
    if result is None:
        return None
    value = result.reward
    if objective is POSE_ERROR:
        value = math.nan if result.imitation is None else result.imitation.pose_error_m
    return value if math.isfinite(value) else None


@contextmanager
def load_player(cfg: DictConfig) -> Iterator[Any]:
    """Yield rl_games' player of a composed tree's checkpoint; close the player's task at the end.

    `player.env` is the task, and `player.act(obs)` returns actions for `evaluation.evaluate`.

    Raises:
        UserError: the tree cannot be used, or the checkpoint belongs to another network or task.
    """
    launch = _read_launch(_checked(cfg))
    with _open_tasks(launch) as make_task:
        yield _make_player(launch, make_task(launch.num_envs))


# --- from a tree to a task and an agent ---------------------------------------------------------


@dataclass(frozen=True)
class _Launch(CheckedConfig):
    """A configuration with the seed, the names and the files of a run.

    Attributes:
        seed: the agent's seed.
        name: the name of the checkpoints, which is the last component of the run's name.
        folder: the run folder, which only a training makes.
        checkpoint: path of the checkpoint from which the run starts, or '' without one.
    """

    seed: int
    name: str
    folder: RunFolder
    checkpoint: str

    @property
    def task_name(self) -> str:
        return str(self.tree["task"]["name"])

    @property
    def num_envs(self) -> int:
        return int(self.tree["task"]["env"]["numEnvs"])

    @property
    def overrides(self) -> dict[str, Any]:
        """Arguments of rl_games' Runner that replace the initial parameters of the networks."""
        return {"checkpoint": self.checkpoint or None, "sigma": self.settings.sigma}

    def checkpoint_file(self, suffix: str = "") -> Path:
        """Return the path of a checkpoint of the run; '' gives the path of the best checkpoint."""
        return self.folder.checkpoints / f"{self.name}{suffix}.pth"


def _checked(cfg: DictConfig | CheckedConfig) -> CheckedConfig:
    return cfg if isinstance(cfg, CheckedConfig) else read_config(cfg)


def _read_launch(config: CheckedConfig) -> _Launch:
    """Find the checkpoint of a configuration, and seed Python, numpy and torch."""
    settings, tree = config.settings, config.tree
    seed = resolve_seed(settings.seed, settings.torch_deterministic)
    seed_everything(seed, settings.torch_deterministic)
    name = run_name_of(tree)
    train_dir = Path(select(tree, TRAIN_DIR) or DEFAULT_TRAIN_DIR)
    if settings.resume:
        if not Path(settings.resume).is_file():
            raise ConfigError(
                f"resume={settings.resume}: a program composes such a tree with"
                " checkpoints.run_config.resumed_tree(['resume=...'])"
            )
        folder = RunFolder.at(run_of_file(Path(settings.resume)), train_dir)
        return _Launch(settings, tree, config.cfg, seed, name.name, folder, settings.resume)
    if exact := settings.full_experiment_name:
        folder = RunFolder(train_dir, str(read_run_name(exact, "full_experiment_name")))
    else:
        stamped = str(name) + run_suffix(tree) + datetime.now().strftime("_%d-%H-%M-%S")
        folder = RunFolder(train_dir, stamped, is_exact=False)
    given = settings.checkpoint or checkpoint_in_file(tree)
    checkpoint = checkpoints.checkpoint_of_tree(tree, given, train_dir)
    if checkpoint:
        log.info("checkpoint: %s", checkpoint)
    return _Launch(settings, tree, config.cfg, seed, name.name, folder, checkpoint)


@contextmanager
def _joined_processes(config: CheckedConfig) -> Iterator[ProcessGroup]:
    """Yield the group of the processes that torchrun has started, or of this process alone."""
    settings = config.settings
    if not settings.multi_gpu and started_by_torchrun():
        raise ConfigError(
            f"torchrun has started {os.environ['WORLD_SIZE']} processes, but multi_gpu is False:"
            " add multi_gpu=True to train one policy together, or leave torchrun out"
        )
    if not settings.multi_gpu:
        yield ProcessGroup()
        return
    with joined_group(settings.rl_device, settings.distributed_timeout_s) as group:
        versions = {f"version of {name}": metadata.version(name) for name in _SAME_VERSIONS}
        values = leaves(OmegaConf.to_container(config.cfg, resolve=False))
        flat = {path: str(value) for path, value in values if path not in _OF_MACHINES}
        group.check_equal({**versions, **flat}, "setting")
        yield group


def _read_launch_together(config: CheckedConfig, group: ProcessGroup, stack: ExitStack) -> _Launch:
    """Return the launch of this process.

    The main process chooses the run folder, the checkpoint, the precision and the seed; every
    process adds its rank to the seed. The main process reserves the run folder until `stack` ends.
    """
    main: _Launch | None = None
    with group.together():
        if group.is_main:
            main = _read_launch(config)
            decided = first_mutation(config.tree, main.seed)
            # config.yaml stores the measured precision, so that a resumed run uses the same.
            if (precision := select(config.tree, _PRECISION)) == "auto":
                device = config.settings.rl_device
                decided[_PRECISION] = resolve_mixed_precision(precision, device)
            if decided:
                main = replace(main, **vars(config.changed(decided)))
            stack.enter_context(main.folder)
    decided = group.from_main(
        main
        and {
            "seed": main.seed,
            "full_experiment_name": main.folder.name,
            "checkpoint": "" if main.settings.resume else main.checkpoint,
            _PRECISION: select(main.tree, _PRECISION),
            **mutable_settings(main.tree),
        }
    )
    if main is not None:
        return main
    decided["seed"] += group.rank
    if select(config.tree, _PRECISION) != "auto":
        del decided[_PRECISION]
    device = group.device_of(config.settings.rl_device)
    return _read_launch(config.changed({**decided, **_QUIET, "rl_device": device}))


def _check_settings(launch: _Launch, task: VecTask, settings: Mapping[str, float]) -> None:
    """Check changed settings as a new run would; `settings` maps paths of keys to values."""
    changed = replace(launch, **vars(launch.changed(settings)))
    with _quiet("isaacgymenvs_lite"), _open_tasks(changed) as make_task:
        make_task(1)
        _read_params(changed, task)


@contextmanager
def _open_tasks(launch: _Launch) -> Iterator[Callable[[int], VecTask]]:
    """Yield a function that makes the task of the tree with a given number of environments.

    At the end, even after an error, all tasks are closed and torch's number of threads is restored.
    """
    settings = launch.settings
    with ExitStack() as opened:
        opened.callback(torch.set_num_threads, torch.get_num_threads())

        def make(num_envs: int) -> VecTask:
            tree = copy.deepcopy(launch.tree)
            tree["task"]["env"]["numEnvs"] = num_envs
            task = make_from_config(
                tree,
                sim_device=settings.sim_device,
                rl_device=settings.rl_device,
                graphics_device_id=settings.graphics_device_id,
                headless=settings.headless,
                virtual_screen_capture=settings.capture_video,
                force_render=settings.force_render,
            )
            opened.callback(task.close)
            return task

        yield make


def _read_params(launch: _Launch, task: VecTask) -> dict[str, Any]:
    """Return the train file's section `params`, checked and completed for a task."""
    from isaacgymenvs_lite.registration import build_runner, known_names  # rl_games' Runner

    settings = launch.settings
    params = prepare_train_params(
        launch.tree,
        num_envs=task.num_envs,
        seed=launch.seed,
        run_name=launch.folder.name,
        rl_device=settings.rl_device,
        num_agents=task.num_agents,
        num_states=task.num_states,
        names=known_names(build_runner()),
    )
    check_env_name(params)
    params["config"] |= {"train_dir": str(launch.folder.train_dir), "resume": settings.resume}
    if launch.checkpoint:  # agents need the path; the user may have given `last`
        params |= {"load_checkpoint": True, "load_path": launch.checkpoint}
    if settings.latent:
        params["config"].setdefault("player", {})["latent"] = settings.latent
    # rl_games reads this key; without the key it uses at most four threads.
    params.setdefault("torch_threads", thread_count(settings.num_threads))
    return params


def _load_runner(
    params: dict[str, Any], task: VecTask, observer: AlgoObserver | None = None
) -> Any:
    """Return rl_games' Runner for a train file and a task; only a training has an observer."""
    from isaacgymenvs_lite.registration import build_runner
    from isaacgymenvs_lite.wrappers.rl_games_env import RLGPUEnv

    vec_env = RLGPUEnv.from_task(task)
    runner = build_runner(observer)
    runner.load({"params": params})
    # `load` has copied its argument, so the task is set here. A player acts in the task without the
    # wrapper.
    runner.params["config"] |= {
        "vec_env": vec_env if observer is not None else task,
        "env_info": vec_env.get_env_info(),
    }
    return runner


def _make_player(launch: _Launch, task: VecTask) -> Any:
    """Return rl_games' player of the checkpoint in a task."""
    if not launch.checkpoint:
        log.warning("test=True without checkpoint=: playing an untrained policy")
    with _quiet("isaacgymenvs_lite.config"):  # notes about minibatches concern only trainings
        params = _read_params(launch, task)
    with _output_to_log():
        player = _load_runner(params, task).create_player()
        if launch.checkpoint:
            player.restore(launch.checkpoint)
        from rl_games.torch_runner import _override_sigma

        _override_sigma(player, launch.overrides)
    return player


def _measurement_observer(
    config: dict[str, Any], task: VecTask, make_task: Callable[[int], VecTask]
) -> MeasurementObserver | None:
    """Return the observer that measures the mean policy, or None if nothing is to be measured.

    For a task without reference motions the observer also chooses the best checkpoint, and it makes
    at most about 20 measurements.
    """
    has_motions = hasattr(task, "motion_lib")
    frequency = config.get("imitation_frequency", _DEFAULT_IMITATION_FREQUENCY)
    if frequency == 0 or (not has_motions and task.max_episode_length > _LONGEST_MEASURED):
        return None
    if not has_motions and (epochs := config.get("max_epochs", -1)) > 0:
        frequency = max(1, min(frequency, epochs // _MEASUREMENTS))

    def make_quietly(num_envs: int) -> VecTask:
        # The task of the training has already logged the contents of the same files.
        with _quiet("isaacgymenvs_lite"):
            return make_task(num_envs)

    return MeasurementObserver(
        make_quietly, frequency, _MEASURED_EPISODES, chooses_best=not has_motions
    )


# --- the start and the end of a run ---------------------------------------------------------


def _stored_config(launch: _Launch) -> DictConfig:
    """Return the tree for config.yaml, with the drawn seed and without `resume`.

    Interpolations that read anything other than the configuration, for example `${oc.env:X}`, are
    replaced by their values. A config.yaml that contains them would be refused when it is read.
    """
    cfg = launch.cfg.copy()
    for path, text in leaves(OmegaConf.to_container(cfg, resolve=False)):
        if isinstance(text, str) and forbidden_resolver(text):
            OmegaConf.update(cfg, path, select(launch.tree, path))
    with open_dict(cfg):
        cfg.seed, cfg.resume = launch.seed, ""
    return cfg


def _log_opening(launch: _Launch, has_clips: bool) -> None:
    """Log the task, the algorithm, the clip, the run folder, and commands that show the curves."""
    tree, folder = launch.tree, launch.folder
    clip = tree["task"]["env"].get("motion_file")
    on = f" on {Path(str(clip)).name}" if clip and has_clips else ""
    log.info(
        "training %s with %s%s in %d environments: %s",
        *(launch.task_name, tree["train"]["params"]["algo"]["name"], on),
        *(launch.num_envs, folder.path),
    )
    log.info(
        "its curves: tensorboard --logdir %s; a report as a web page: %s",
        *(folder.train_dir, package_command("report", str(folder.path))),
    )


def _begin(folder: RunFolder) -> None:
    """Write the settings of the training into the run folder."""
    folder.begin()
    mark_run(folder.path)


def _save(agent: Any, launch: _Launch, suffix: str = "") -> None:
    """Write a checkpoint if there is an agent; an empty suffix makes it the best checkpoint."""
    if agent is None:
        return
    with _output_to_log():
        if not suffix and hasattr(agent, "save_best"):  # agents of other projects lack `save_best`
            agent.save_best()
        else:
            agent.save(str(launch.checkpoint_file(suffix).with_suffix("")))


def _report_end(
    launch: _Launch,
    command: TypedCommand,
    group: ProcessGroup,
    was_stopped: bool,
    plays_best: bool,
) -> None:
    """Log the path of the best or newest checkpoint, and the commands that play or resume it."""
    best, newest = launch.checkpoint_file(), launch.folder.newest_checkpoint()
    if newest is None:
        return
    played = best if plays_best and best.exists() else newest
    if launch.settings.resume:  # this process does not know the first command
        name = "last" if played == newest else played.absolute()
        play = f"add test=True checkpoint={name} to the command that started the run"
    else:
        play = command.play(launch.task_name, played.absolute(), is_newest=played == newest)
    log.info("saved %s; play it: %s", played, play)
    if was_stopped:
        log.info("go on with it: %s", command.resume(launch.folder.path, group.size))


def _unsaved(folder: RunFolder) -> CheckpointError:
    """Return the error for the case that the last checkpoint could be written nowhere."""
    newest = folder.newest_checkpoint()
    saved = f"the newest checkpoint is {newest}" if newest else "this training has no checkpoint"
    return CheckpointError(
        f"the last checkpoint could not be written, neither to {folder.checkpoints} nor below the"
        f" temporary folder; {saved}; free some space, or choose another folder with"
        " +train.params.config.train_dir=FOLDER"
    )


@contextmanager
def _memory_errors_explained(config: CheckedConfig) -> Iterator[None]:
    """Turn a memory error of Python, torch or MuJoCo into one line about the settings."""
    try:
        yield
    except (MemoryError, RuntimeError, ValueError) as error:
        texts = ("can't allocate memory", "out of memory", "bad_alloc")
        is_lack = isinstance(error, MemoryError) or any(text in str(error) for text in texts)
        if isinstance(error, UserError) or not is_lack:
            raise
        raise ConfigError(
            "not enough memory for this training: lower num_envs"
            f" ({config.tree['task']['env']['numEnvs']} now), train.params.config.horizon_length or"
            f" train.params.network.mlp.units ({one_line(error) or 'MemoryError'})"
        ) from error


# --- logs ---------------------------------------------------------------------------------------


@contextmanager
def _quiet(logger_name: str) -> Iterator[None]:
    """Limit a logger to warnings."""
    logger = logging.getLogger(logger_name)
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)


class _LogStream(io.TextIOBase):
    """A text stream that logs its lines as debug records."""

    def write(self, text: str) -> int:
        for line in text.splitlines():
            if line.strip():
                _rl_games_log.debug("%s", line)
        return len(text)


def _output_to_log() -> contextlib.redirect_stdout[_LogStream]:
    """Redirect the prints of rl_games to the log, as debug records."""
    return contextlib.redirect_stdout(_LogStream())
