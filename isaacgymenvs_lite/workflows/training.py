"""Training and playing an agent of any library, from the command line to the last checkpoint.

`train` and `play` are the story: read the agent file, make task and agent, load a checkpoint, start
the viewers, then learn or step. They use a library through `library.Agent` only.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
import yaml
from omegaconf import OmegaConf

from isaacgymenvs_lite.config.compose import compose_task
from isaacgymenvs_lite.config.launch import check_config, resolve_seed
from isaacgymenvs_lite.env_factory import make_from_config, seed_everything
from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.paths import user_path
from isaacgymenvs_lite.run.stop_request import signals_as_ctrl_c
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.typed_command import package_command
from isaacgymenvs_lite.utils.threads import limit_torch_threads, threads_for_products
from isaacgymenvs_lite.viewers.start import Viewers
from isaacgymenvs_lite.workflows.agent_files import load_agent_file, seed_of
from isaacgymenvs_lite.workflows.command import (
    LAST,
    Command,
    CommandSettings,
    PlaySettings,
    TrainSettings,
)
from isaacgymenvs_lite.workflows.library import Library
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask

log = logging.getLogger(__name__)

_ENV_FILE, _AGENT_FILE = "params/env.yaml", "params/agent.yaml"


def train(library: Library, command: Command[TrainSettings]) -> None:
    """Train as a command line says.

    Raises:
        UserError: a key, a value or a file that cannot be used.
    """
    settings, name = command.settings, _task_name(command.settings)
    checkpoint = find_checkpoint(library, settings) if settings.checkpoint else None
    content = load_agent_file(library.name, name, settings.agent, command.agent_words)
    if settings.max_iterations is not None:
        content["max_iterations"] = settings.max_iterations
    words = [f"seed={seed_of(content)}", *command.task_words]
    with task_session(settings.task, words, plays=False) as session:
        agent = library.make_agent(session.task, content, session.rl_device, session.seed)
        session.limit_threads(agent.minibatch_rows * agent.num_parameters)
        if checkpoint is not None:
            agent.load(checkpoint)
        folder = create_folder(Path(settings.logs) / library.name / name, session.made_of, content)
        log.info("log folder: %s", folder)
        session.viewers.start(session.task, folder, _interrupt)
        try:
            with signals_as_ctrl_c():
                agent.learn(folder, settings.log_interval)
        except KeyboardInterrupt:
            log.info("stopped; saved %s", agent.save(folder))
            raise


def play(library: Library, command: Command[PlaySettings]) -> None:
    """Play one episode in each environment and print returns and lengths.

    Raises:
        UserError: a key, a value or a file that cannot be used.
    """
    settings, name = command.settings, _task_name(command.settings)
    checkpoint = find_checkpoint(library, settings)
    places = checkpoint.parents[:2]
    run = next((place for place in places if (place / _AGENT_FILE).is_file()), None)
    file = settings.agent or ("" if run is None else str(run / _AGENT_FILE))
    content = load_agent_file(library.name, name, file, command.agent_words)
    words = [f"seed={seed_of(content)}", *command.task_words]
    with task_session(settings.task, words, plays=True) as session:
        task = session.task
        agent = library.make_agent(task, content, session.rl_device, session.seed)
        session.limit_threads(task.num_envs * agent.num_parameters)
        agent.load(checkpoint)
        log.info("checkpoint: %s", checkpoint)
        session.viewers.start(task, run or checkpoint.parent, _interrupt, f"play_{_date()}")
        step = agent.player()
        if settings.real_time:
            step = in_real_time(step, task.simulation.dt)
        sys.stdout.write("\n".join([*play_episodes(agent.stepper, step).lines(), ""]))
        sys.stdout.flush()
        with contextlib.suppress(KeyboardInterrupt):
            while task.is_watched:
                step()


def _task_name(settings: CommandSettings) -> str:
    """Return the name that agent files and log folders have: `Ant` also for `my/Ant.yaml`."""
    return Path(settings.task).stem


def _date() -> str:
    return datetime.now().strftime("%Y-%m-%d_%H-%M-%S-%f")


def _interrupt() -> None:
    """End as Ctrl-C does, because the window was closed."""
    raise KeyboardInterrupt


@dataclass(frozen=True)
class TaskSession:
    """A task with its viewers.

    Attributes:
        task: the task.
        made_of: the configuration that it was made from, as plain values.
        rl_device: torch device of the agent.
        seed: of the agent.
        num_threads: the key of the same name; 0 chooses.
        viewers: videos, window and page, not started yet.
    """

    task: VecTask
    made_of: dict[str, Any]
    rl_device: str
    seed: int
    num_threads: int
    viewers: Viewers

    def limit_threads(self, products: int) -> None:
        """Let torch use as many threads as shorten a step, until the task is closed.

        Args:
            products: rows that the networks are evaluated for at once, times their parameters.
        """
        limit_torch_threads(self.task, threads_for_products(products), self.num_threads)


@contextlib.contextmanager
def task_session(name: str, words: Sequence[str], *, plays: bool) -> Iterator[TaskSession]:
    """Seed the random generators and make a task; at the end finish videos and free the task.

    Args:
        name: of a task file, or its path.
        words: `key=value` as on train.py's command line.
        plays: whether an agent is played, not trained.

    Raises:
        UserError: a word or a value that train.py refuses too.
    """
    cfg = compose_task(name, words)
    settings = check_config(cfg)
    viewers = Viewers(dataclasses.replace(settings, test=plays))
    seed = resolve_seed(settings.seed, settings.torch_deterministic)
    seed_everything(seed, settings.torch_deterministic)
    device = settings.rl_device
    task = make_from_config(
        cfg, sim_device=settings.sim_device, rl_device=device, graphics_device_id=-1
    )
    made_of = {
        "task": OmegaConf.to_container(cfg.task, resolve=True),
        "seed": seed,
        "rl_device": device,
    }
    try:
        yield TaskSession(task, made_of, device, seed, settings.num_threads, viewers)
    finally:
        viewers.close()
        task.close()


def create_folder(trainings: Path, env: Mapping[str, Any], agent: Mapping[str, Any]) -> Path:
    """Make the folder of a training, and write its configuration to `params/`.

    Args:
        trainings: folder of the task's trainings, logs/<library>/<task>.
        env: the task's configuration.
        agent: the agent's.

    Raises:
        ConfigError: the folder cannot be written.
    """
    folder = trainings / _date()
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


def find_checkpoint(library: Library, settings: CommandSettings) -> Path:
    """Return the checkpoint that the command line names, else the task's newest one.

    Raises:
        CheckpointError: there is none.
    """
    if settings.checkpoint not in ("", LAST):
        checkpoint = user_path(settings.checkpoint)
        if not checkpoint.is_file():
            raise CheckpointError(f"checkpoint={checkpoint}: no such file")
        return checkpoint
    task = _task_name(settings)
    folder = Path(settings.logs) / library.name / task
    files = [file for pattern in library.checkpoints for file in folder.glob(f"*/{pattern}")]
    if not files:
        command = package_command("workflows", library.name, "train")
        raise CheckpointError(
            f"no checkpoint below {folder.absolute()}; train one first, or give checkpoint=FILE:"
            f" {command} task={task}"
        )
    return max(files, key=lambda file: file.stat().st_mtime)


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
