"""From a composed configuration to a trained or played policy."""

from __future__ import annotations

import contextlib
import io
import itertools
import logging
from collections.abc import Iterator
from contextlib import nullcontext
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from rl_games.common.algo_observer import AlgoObserver
from rl_games.torch_runner import Runner

from isaacgymenvs_lite.checkpoints import files as checkpoints
from isaacgymenvs_lite.config.launch import LaunchSettings, check_config, resolve_seed
from isaacgymenvs_lite.config.run_names import read_run_name, run_name_of
from isaacgymenvs_lite.config.startup_notes import startup_notes
from isaacgymenvs_lite.config.train_params import (
    KnownNames,
    apply_wrapper_limits,
    check_env_name,
    checkpoint_in_file,
    prepare_train_params,
)
from isaacgymenvs_lite.env_factory import make_from_config, seed_everything
from isaacgymenvs_lite.errors import ConfigError, NotFiniteError, UserError, one_line
from isaacgymenvs_lite.learning.amp_config import AGENT_KEYS
from isaacgymenvs_lite.registration import build_runner, known_names, register_env
from isaacgymenvs_lite.run import (
    DiagnosticsObserver,
    ImitationObserver,
    MetricsObserver,
    MultiObserver,
    ProgressObserver,
    TaskScalarsObserver,
)
from isaacgymenvs_lite.run.event_writer import install
from isaacgymenvs_lite.run.folder import RunFolder, run_of_checkpoint
from isaacgymenvs_lite.run.stop_request import StopRequest
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.typed_command import TypedCommand
from isaacgymenvs_lite.utils.threads import thread_count
from isaacgymenvs_lite.viewers.start import Viewers
from isaacgymenvs_lite.viewers.window import WindowClosedError

log = logging.getLogger(__name__)
_rl_games_log = logging.getLogger("rl_games")

_DEFAULT_IMITATION_FREQUENCY = 50
_IMITATION_EPISODES = 16
# Keys of train.params.config that are read here, beside those of the agents.
_RUNNER_KEYS = ("imitation_frequency", "print_disc_prediction")


def run(cfg: DictConfig, command: TypedCommand | None = None) -> None:
    """Train (`test=False`) or play (`test=True`) as a composed tree says.

    Args:
        cfg: the tree.
        command: the command line that it was composed from, if it was; for hints.

    Raises:
        UserError: anything that the user can mend; nothing was trained then.
    """
    settings = check_config(cfg)
    apply_wrapper_limits(cfg)
    command = command or TypedCommand()
    for note in startup_notes(cfg, command.check(str(cfg.task.name))):
        log.info("%s", note)
    seed = resolve_seed(settings.seed, settings.torch_deterministic)
    seed_everything(seed, settings.torch_deterministic)
    try:
        Session(cfg, settings, seed, command).run()
    except (MemoryError, RuntimeError, ValueError) as error:
        if isinstance(error, UserError) or not _is_out_of_memory(error):
            raise
        raise ConfigError(
            "not enough memory for this training: lower num_envs"
            f" ({cfg.task.env.numEnvs} now), train.params.config.horizon_length or"
            f" train.params.network.mlp.units ({one_line(error) or 'MemoryError'})"
        ) from error


def _is_out_of_memory(error: BaseException) -> bool:
    """Return whether Python, torch or MuJoCo could not get memory; each has words of its own."""
    texts = ("can't allocate memory", "out of memory", "bad_alloc")
    return isinstance(error, MemoryError) or any(text in str(error) for text in texts)


class Session:
    """One training or one play: what belongs to it and must be closed after it."""

    def __init__(
        self,
        cfg: DictConfig,
        settings: LaunchSettings,
        seed: int,
        command: TypedCommand | None = None,
    ) -> None:
        self._cfg = cfg
        self._command = command or TypedCommand()
        self._settings = settings
        self._viewers = Viewers(settings)
        self._seed = seed
        name = run_name_of(cfg)
        self._name = name.name  # of the checkpoints
        train_dir = Path(OmegaConf.select(cfg, "train.params.config.train_dir") or "runs")
        if exact := settings.full_experiment_name:
            self._run_name = str(read_run_name(exact, "full_experiment_name"))
        else:
            self._run_name = _new_run_name(train_dir, str(name))
        self._folder = RunFolder(train_dir, self._run_name)
        asked = settings.checkpoint or checkpoint_in_file(cfg)
        self._checkpoint = checkpoints.checkpoint_of_tree(cfg, asked, train_dir)
        self._stop = StopRequest()
        self._envs: list[VecTask] = []
        self._agent_holder = _AgentHolder()

    def run(self) -> None:
        """Train or play; the simulations are freed in any case.

        Raises:
            UserError: anything that the user can mend; nothing was trained then.
        """
        threads = torch.get_num_threads()
        if self._checkpoint:
            log.info("checkpoint: %s", self._checkpoint)
        try:
            # Made before the agent, so that its mistakes show before a run folder exists.
            self._task = self._make_env(int(self._cfg.task.env.numEnvs))
            register_env(lambda **kwargs: self._task)
            # What is fitted to the batch of a training is of no interest to a player.
            with _quiet("isaacgymenvs_lite.config") if self._settings.test else nullcontext():
                self._params = self._prepare()
            if self._settings.test:
                self._play()
            else:
                self._train()
        finally:
            torch.set_num_threads(threads)
            register_env()  # the task made here is of no use to others
            self._viewers.close()
            for env in self._envs:
                env.close()

    def _prepare(self) -> dict[str, Any]:
        runner = build_runner()
        params = prepare_train_params(
            self._cfg,
            num_envs=self._task.num_envs,
            seed=self._seed,
            run_name=self._run_name,
            rl_device=self._settings.rl_device,
            num_agents=self._task.num_agents,
            num_states=self._task.num_states,
            names=registered_names(runner),
        )
        check_env_name(params)
        if self._checkpoint:  # the file that `last` or a name means, for agents that look into it
            params |= {"load_checkpoint": True, "load_path": self._checkpoint}
        if self._settings.latent:
            params["config"].setdefault("player", {})["latent"] = self._settings.latent
        # rl_games sets torch's threads by this key, to at most four by default.
        params.setdefault("torch_threads", thread_count(self._settings.num_threads))
        return params

    def _make_env(self, num_envs: int) -> VecTask:
        cfg = self._cfg.copy()
        OmegaConf.update(cfg, "task.env.numEnvs", num_envs)
        env = make_from_config(
            cfg,
            sim_device=self._settings.sim_device,
            rl_device=self._settings.rl_device,
            graphics_device_id=self._settings.graphics_device_id,
            headless=self._settings.headless,
            virtual_screen_capture=self._settings.capture_video,
            force_render=self._settings.force_render,
        )
        self._envs.append(env)
        return env

    def make_player(self) -> Any:
        """Return rl_games' player of the checkpoint, with the task that was made.

        Raises:
            CheckpointError: the checkpoint is of another network or task.
        """
        runner = build_runner()
        with _output_to_log():
            runner.load({"params": self._params})
            player = runner.create_player()
            player.restore(self._checkpoint)
        return player

    def _play(self) -> None:
        if not self._checkpoint:
            log.warning("test=True without checkpoint=: playing an untrained policy")
        folder = run_of_checkpoint(self._checkpoint) or self._folder.path
        prefix = f"play{Path(self._run_name).name.removeprefix(self._name)}"
        self._viewers.start(self._task, folder, _end_play, prefix)
        with contextlib.suppress(WindowClosedError):
            self._launch({"train": False, "play": True}, AlgoObserver())

    def _train(self) -> None:
        self._folder.create(self._cfg)
        imitation = self._imitation_observer()
        figures = MetricsObserver()
        interval_s = self._settings.progress_interval
        progress = ProgressObserver(self._stop, figures, imitation, interval_s)
        observers: list[AlgoObserver] = [self._agent_holder, TaskScalarsObserver()]
        wandb = None
        if self._settings.wandb_activate:
            from isaacgymenvs_lite.run.wandb_observer import WandbObserver

            wandb = WandbObserver(self._cfg, self._settings, self._run_name)
            observers.append(wandb)
        if imitation is not None:
            observers.append(imitation)
        advice = DiagnosticsObserver(figures, imitation, self._task.max_episode_length)
        observers += [figures, progress, advice]
        self._params["config"]["print_stats"] = False
        try:
            self._viewers.start(self._task, self._folder.path, self._stop.ask)
            with self._stop:
                self._launch({"train": True, "play": False}, MultiObserver(observers))
        except NotFiniteError:
            raise  # what is in the run folder says how it came to it
        except UserError:
            self._folder.remove_if_unused()
            raise
        except KeyboardInterrupt:
            log.warning("stopped at once")
            self._save("interrupted")
        finally:
            progress.close()
            self._agent_holder.flush()
            self._viewers.close()  # its last videos belong to wandb's run, too
            if wandb is not None:
                wandb.close()
        self._save_under_plain_name()
        self._report_end()

    def _imitation_observer(self) -> ImitationObserver | None:
        frequency = self._params["config"].get("imitation_frequency", _DEFAULT_IMITATION_FREQUENCY)
        if not isinstance(frequency, int) or frequency < 0:
            raise ConfigError(
                f"train.params.config.imitation_frequency={frequency!r}: expected epochs between"
                " evaluations, 0 for none"
            )
        if frequency == 0 or not hasattr(self._task, "motion_lib"):
            return None
        return ImitationObserver(self._make_env, frequency, _IMITATION_EPISODES)

    def _launch(self, mode: dict[str, bool], observer: AlgoObserver) -> None:
        """Hand over to rl_games."""
        runner = build_runner(observer)
        sigma = self._settings.sigma
        with _output_to_log():
            runner.load({"params": self._params})
            runner.run({**mode, "checkpoint": self._checkpoint or None, "sigma": sigma})

    def _save(self, suffix: str) -> None:
        agent = self._agent_holder.agent
        if agent is not None:
            with _output_to_log():
                agent.save(str(self._folder.checkpoints / f"{self._name}_{suffix}"))

    def _report_end(self) -> None:
        """Say where the newest checkpoint is and how to see what it can do."""
        newest = self._folder.newest_checkpoint()
        if newest is None:
            return
        task = str(self._cfg.task.name)
        log.info("saved %s; play it: %s", newest, self._command.play(task))
        if self._stop.requested:
            log.info("go on with it: %s", self._command.resume(task))

    def _save_under_plain_name(self) -> None:
        """Make sure that nn/<name>.pth exists.

        rl_games writes it for a best reward after `save_best_after` epochs, which short runs never
        reach.
        """
        agent = self._agent_holder.agent
        plain = self._folder.checkpoints / f"{self._name}.pth"
        if agent is not None and not plain.exists():
            with _output_to_log():
                agent.save(str(plain.with_suffix("")))


def _end_play() -> None:
    raise WindowClosedError


def registered_names(runner: Runner) -> KnownNames:
    """Return what train files may name and which keys its agents read, to check them against."""
    names = known_names(runner)
    keys = AGENT_KEYS.union(_RUNNER_KEYS)
    return KnownNames(names["algo"], names["model"], names["network"], keys)


def _new_run_name(train_dir: Path, name: str) -> str:
    """Return `<name>_<dd-HH-MM-SS>`, with a number behind it if a run of this second exists."""
    stamped = name + datetime.now().strftime("_%d-%H-%M-%S")
    candidates = itertools.chain([stamped], (f"{stamped}_{i}" for i in itertools.count(2)))
    return next(candidate for candidate in candidates if not (train_dir / candidate).exists())


class _AgentHolder(AlgoObserver):
    """Keeps the agent that rl_games' Runner makes and does not hand out, and guards its log."""

    agent: Any = None

    def after_init(self, algo: Any) -> None:
        self.agent = algo
        install(algo.writer)

    def flush(self) -> None:
        """Write the scalars that wait."""
        if self.agent is not None:
            self.agent.writer.flush()


@contextlib.contextmanager
def _quiet(logger_name: str) -> Iterator[None]:
    """Let a logger say warnings only."""
    logger = logging.getLogger(logger_name)
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)


class _LogStream(io.TextIOBase):
    """A text stream whose lines become log records."""

    def write(self, text: str) -> int:
        for line in text.splitlines():
            if line.strip():
                _rl_games_log.debug("%s", line)
        return len(text)


@contextlib.contextmanager
def _output_to_log() -> Iterator[None]:
    """rl_games prints what it does; here that is debug output, not a user's screen."""
    with contextlib.redirect_stdout(_LogStream()):
        yield
