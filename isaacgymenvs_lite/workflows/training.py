"""Training and playing an agent of any library, from the command line to the last checkpoint.

`_train` and `_play` are the story: read the agent file, make task and agent, load a checkpoint,
start the viewers, then learn or step. They use a library through `library.Agent` only.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
import yaml
from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite.config.compose import compose_task
from isaacgymenvs_lite.config.launch import check_config, resolve_seed
from isaacgymenvs_lite.env_factory import make_from_config, seed_everything
from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.paths import user_path
from isaacgymenvs_lite.run.stop_request import signals_as_ctrl_c
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.utils.threads import limit_torch_threads, threads_for_products
from isaacgymenvs_lite.viewers.start import Viewers
from isaacgymenvs_lite.workflows.agent_files import load_agent_file, seed_of
from isaacgymenvs_lite.workflows.command import (
    LAST,
    Command,
    CommandSettings,
    PlaySettings,
    TrainSettings,
    run_workflow,
)
from isaacgymenvs_lite.workflows.library import Library, read_parameters
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask

log = logging.getLogger(__name__)

_ENV_FILE, _AGENT_FILE = "params/env.yaml", "params/agent.yaml"


def train(library: Library, arguments: Sequence[str] | None = None) -> int:
    """Train as the command line says; return the exit code.

    Args:
        library: whose agent.
        arguments: without the program's name; None = `sys.argv`.
    """
    return run_workflow(
        library, "train", TrainSettings, lambda command: _train(library, command), arguments
    )


def _train(library: Library, command: Command[TrainSettings]) -> None:
    settings, name = command.settings, _task_name(command.settings)
    checkpoint = find_checkpoint(library, settings) if settings.checkpoint else None
    content = load_agent_file(library.name, name, settings.agent, command.agent_words)
    if settings.max_iterations is not None:
        content["max_iterations"] = settings.max_iterations
    with make_task(settings.task, command.task_words, seed_of(content), plays=False) as session:
        agent = library.make_agent(session.task, content, session.rl_device, session.seed)
        session.limit_threads(agent.minibatch_rows, agent.num_parameters)
        if checkpoint is not None:
            agent.load(checkpoint)
        folder = create_folder(Path(settings.logs), library, name, session.settings, content)
        log.info("log folder: %s", folder)
        session.start_viewers(folder)
        try:
            with signals_as_ctrl_c():
                agent.learn(folder, settings.log_interval)
        except KeyboardInterrupt:
            log.info("stopped; saved %s", agent.save(folder))
            raise


def play(library: Library, arguments: Sequence[str] | None = None) -> int:
    """Play one episode in each environment and print returns and lengths; return the exit code.

    Args:
        library: whose agent.
        arguments: without the program's name; None = `sys.argv`.
    """
    return run_workflow(
        library, "play", PlaySettings, lambda command: _play(library, command), arguments
    )


def _play(library: Library, command: Command[PlaySettings]) -> None:
    settings, name = command.settings, _task_name(command.settings)
    checkpoint = find_checkpoint(library, settings)
    file = settings.agent or str(agent_file_of(checkpoint) or "")
    content = load_agent_file(library.name, name, file, command.agent_words)
    with make_task(settings.task, command.task_words, seed_of(content), plays=True) as session:
        agent = library.make_agent(session.task, content, session.rl_device, session.seed)
        session.limit_threads(session.task.num_envs, agent.num_parameters)
        agent.load(checkpoint)
        log.info("checkpoint: %s", checkpoint)
        session.start_viewers(folder_of(checkpoint), f"play_{_date()}")
        step = agent.player()
        if settings.real_time:
            step = in_real_time(step, session.task.simulation.dt)
        sys.stdout.write("\n".join([*play_episodes(agent.stepper, step).lines(), ""]))
        sys.stdout.flush()
        with contextlib.suppress(KeyboardInterrupt):
            while session.task.is_watched:
                step()


def _task_name(settings: CommandSettings) -> str:
    """Return the name that agent files and log folders have: `Ant` also for `my/Ant.yaml`."""
    return Path(settings.task).stem


# --- the task --------------------------------------------------------------------------------


@dataclass(frozen=True)
class TaskSession:
    """A task with its viewers; leaving the `with` statement finishes videos and frees the task.

    Attributes:
        task: the task.
        settings: the configuration that it was made from, as plain values.
        rl_device: torch device of the agent.
        seed: of the agent.
        num_threads: the key of the same name; 0 chooses.
        viewers: videos, window and page, once started.
    """

    task: VecTask
    settings: dict[str, Any]
    rl_device: str
    seed: int
    num_threads: int
    viewers: Viewers

    def start_viewers(self, folder: Path, prefix: str = "rl-video") -> None:
        """Start the viewers that the command line names.

        Args:
            folder: of the training; videos go to `videos/` in it.
            prefix: of the names of videos.
        """
        self.viewers.start(self.task, folder, _interrupt, prefix)

    def limit_threads(self, rows: int, num_parameters: int) -> None:
        """Let torch use as many threads as shorten a step, until the task is closed.

        Args:
            rows: that the networks are evaluated for at once.
            num_parameters: of the networks.
        """
        most = threads_for_products(rows * num_parameters)
        limit_torch_threads(self.task, most, self.num_threads)

    def __enter__(self) -> TaskSession:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.viewers.close()
        self.task.close()


def make_task(name: str, words: Sequence[str], seed: int, *, plays: bool) -> TaskSession:
    """Seed the random generators and make a task.

    Args:
        name: of a task file, or its path.
        words: `key=value` as on train.py's command line.
        seed: unless `words` have one.
        plays: whether an agent is played, not trained.

    Raises:
        UserError: a word or a value that train.py refuses too.
    """
    cfg = compose_task(name, [f"seed={seed}", *words])
    settings = check_config(cfg)
    viewers = Viewers(dataclasses.replace(settings, test=plays))
    seed = resolve_seed(settings.seed, settings.torch_deterministic)
    seed_everything(seed, settings.torch_deterministic)
    task = make_from_config(
        cfg, sim_device=settings.sim_device, rl_device=settings.rl_device, graphics_device_id=-1
    )
    return TaskSession(
        task, _as_made(cfg, seed), settings.rl_device, seed, settings.num_threads, viewers
    )


def _as_made(cfg: DictConfig, seed: int) -> dict[str, Any]:
    task = OmegaConf.to_container(cfg.task, resolve=True)
    return {"task": task, "seed": seed, "rl_device": str(cfg.rl_device)}


def _interrupt() -> None:
    """End as Ctrl-C does, because the window was closed."""
    raise KeyboardInterrupt


# --- the folder of a training: logs/<library>/<task>/<date>/ ----------------------------------


def create_folder(
    logs: Path, library: Library, task: str, env: Mapping[str, Any], agent: Mapping[str, Any]
) -> Path:
    """Make the folder of a training, and write its configuration to `params/`.

    Args:
        logs: folder of all trainings.
        library: the library.
        task: name of the task file.
        env: the task's configuration.
        agent: the agent's.

    Raises:
        ConfigError: the folder cannot be written.
    """
    folder = logs / library.name / task / _date()
    try:
        (folder / "params").mkdir(parents=True)
        for name, content in ((_ENV_FILE, env), (_AGENT_FILE, agent)):
            text = yaml.safe_dump(dict(content), sort_keys=False)
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"cannot write the log folder {folder.absolute()} ({error.strerror or error}); choose"
            " another with logs=FOLDER"
        ) from error
    return folder


def _date() -> str:
    return datetime.now().strftime("%Y-%m-%d_%H-%M-%S-%f")


def find_checkpoint(library: Library, settings: CommandSettings) -> Path:
    """Return the checkpoint that the command line names, else the task's newest one.

    Raises:
        CheckpointError: there is none, or it belongs to another library.
    """
    if settings.checkpoint in ("", LAST):
        checkpoint = _last_checkpoint(library, Path(settings.logs), _task_name(settings))
    else:
        checkpoint = user_path(settings.checkpoint)
    read_parameters(checkpoint, library)  # a mistake shows before anything is made
    return checkpoint


def _last_checkpoint(library: Library, logs: Path, task: str) -> Path:
    folder = logs / library.name / task
    files = [file for pattern in library.checkpoints for file in folder.glob(f"*/{pattern}")]
    if not files:
        raise CheckpointError(
            f"no checkpoint below {folder.absolute()}; train one first, or give checkpoint=FILE:"
            f" {library.command('train')} task={task}"
        )
    return max(files, key=lambda file: file.stat().st_mtime)


def agent_file_of(checkpoint: Path) -> Path | None:
    """Return the agent file in the folder of a checkpoint's training, None if there is none."""
    for folder in checkpoint.parents[:2]:
        if (folder / _AGENT_FILE).is_file():
            return folder / _AGENT_FILE
    return None


def folder_of(checkpoint: Path) -> Path:
    """Return the folder of a checkpoint's training; the file's own if it is elsewhere."""
    file = agent_file_of(checkpoint)
    return checkpoint.parent if file is None else file.parent.parent


# --- playing ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class PlayResult:
    """The first episode of each environment.

    Attributes:
        returns: (N,) sums of rewards.
        lengths: (N,) control steps.
        truncated: (N,) bool, ended by the time limit.
    """

    returns: torch.Tensor
    lengths: torch.Tensor
    truncated: torch.Tensor

    def lines(self) -> list[str]:
        """Return a summary for a user."""
        count = len(self.returns)
        returns, lengths = self.returns, self.lengths.double()
        return [
            f"episodes: {count}, {int(self.truncated.sum())} to the time limit",
            f"return: mean {returns.mean():.2f}, min {returns.min():.2f}, max {returns.max():.2f}",
            f"length: mean {lengths.mean():.1f}, min {lengths.min():.0f}, max {lengths.max():.0f}",
        ]


def play_episodes(stepper: AutoresetTask, step: Callable[[], None]) -> PlayResult:
    """Step until every environment has ended an episode, and return the first one of each.

    All episodes that end within a fixed time would contain too many short ones.

    Args:
        stepper: steps the task.
        step: acts and makes one step of `stepper`.
    """
    returns = torch.zeros(stepper.num_envs, dtype=torch.float64)
    lengths = torch.zeros(stepper.num_envs, dtype=torch.int64)
    truncated = torch.zeros(stepper.num_envs, dtype=torch.bool)
    while not lengths.all():
        step()
        assert stepper.last_step is not None
        episodes = stepper.last_step.episodes
        ids = episodes.env_ids.cpu()
        first = lengths[ids] == 0
        returns[ids[first]] = episodes.returns.cpu()[first]
        lengths[ids[first]] = episodes.lengths.cpu()[first]
        truncated[ids[first]] = stepper.last_step.truncated.cpu()[ids[first]]
    return PlayResult(returns, lengths, truncated)


def in_real_time(step: Callable[[], None], dt_s: float) -> Callable[[], None]:
    """Return `step`, delayed so that two steps start at least `dt_s` apart."""
    next_step_s = time.monotonic()

    def delayed() -> None:
        nonlocal next_step_s
        time.sleep(max(0.0, next_step_s - time.monotonic()))
        next_step_s = max(next_step_s, time.monotonic()) + dt_s
        step()

    return delayed
