"""Trains and plays an agent of any library; the agent must implement `library.Agent`."""

from __future__ import annotations

import dataclasses
import importlib
import logging
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
import yaml
from omegaconf import OmegaConf
from torch import Tensor

from isaacgymenvs_lite.config.compose import compose_task
from isaacgymenvs_lite.config.launch import check_config, resolve_seed
from isaacgymenvs_lite.env_factory import make_from_config, seed_everything
from isaacgymenvs_lite.errors import CheckpointError, ConfigError, UserError, one_line
from isaacgymenvs_lite.paths import user_path
from isaacgymenvs_lite.run.stop_request import signals_as_ctrl_c
from isaacgymenvs_lite.schema import read_keys, setting
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.typed_command import package_command
from isaacgymenvs_lite.utils.threads import limit_torch_threads, threads_for_products
from isaacgymenvs_lite.viewers.start import Viewers
from isaacgymenvs_lite.workflows.library import Agent, SeedSettings, load_agent_file
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask

log = logging.getLogger(__name__)

LAST = "last"
"""Value of `checkpoint` that selects the newest checkpoint of the task's trainings."""
_AGENT_FILE = "params/agent.yaml"
_CHECKPOINTS = (".zip", ".pt")


@dataclass(frozen=True, kw_only=True)
class CommandSettings:
    """The common keys of `train` and `play`."""

    task: str = setting()
    """Name or path of a task file."""
    agent: str = setting("")
    checkpoint: str = setting("")
    """Path of a checkpoint, or `last`."""
    logs: str = setting("logs")

    @property
    def name(self) -> str:
        """The task's name in agent files and log folders, for example `Ant` for `my/Ant.yaml`."""
        return Path(self.task).stem


@dataclass(frozen=True, kw_only=True)
class TrainSettings(CommandSettings):
    """The keys of `train`, which starts from the checkpoint if one is given."""

    max_iterations: int | None = setting(None, minimum=1)
    log_interval: int | None = setting(None, minimum=1)
    """Number of frames from one log entry to the next; None selects the library's default."""


@dataclass(frozen=True, kw_only=True)
class PlaySettings(CommandSettings):
    """The keys of `play`."""

    real_time: bool = setting(False)


def train(
    library: str, settings: TrainSettings, task_words: list[str], agent_words: list[str]
) -> None:
    """Train with the settings of a command line; after Ctrl-C a last checkpoint is saved."""
    checkpoint = find_checkpoint(library, settings) if settings.checkpoint else None
    content = load_agent_file(library, settings.name, settings.agent, agent_words)
    if settings.max_iterations is not None:
        content["max_iterations"] = settings.max_iterations
    with _session(library, settings.task, task_words, content, checkpoint) as session:
        agent, env, viewers = session
        folder = Path(settings.logs) / library / settings.name / _date()
        _write_params(folder, {"params/env.yaml": env, _AGENT_FILE: content})
        log.info("log folder: %s", folder)
        viewers.start(agent.stepper.task, folder, _interrupt)
        try:
            with signals_as_ctrl_c():
                agent.learn(folder, settings.log_interval)
        except KeyboardInterrupt:
            log.info("stopped; saved %s", agent.save(folder))
            raise


def play(
    library: str, settings: PlaySettings, task_words: list[str], agent_words: list[str]
) -> None:
    """Play one episode in each environment, and print the episodes' returns and lengths."""
    checkpoint = find_checkpoint(library, settings)
    places = checkpoint.parents[:2]
    run = next((place for place in places if (place / _AGENT_FILE).is_file()), None)
    file = settings.agent or ("" if run is None else str(run / _AGENT_FILE))
    content = load_agent_file(library, settings.name, file, agent_words)
    with _session(library, settings.task, task_words, content, checkpoint, plays=True) as session:
        agent, _, viewers = session
        task = agent.stepper.task
        log.info("checkpoint: %s", checkpoint)
        viewers.start(task, run or checkpoint.parent, _interrupt, f"play_{_date()}")
        policy = agent.policy()
        observations = agent.env.reset()
        if isinstance(observations, tuple):  # Some libraries return (observations, infos).
            observations = observations[0]

        def step() -> None:
            nonlocal observations
            start_s = time.monotonic()
            with torch.no_grad():
                actions = policy(observations)
            observations = agent.env.step(actions)[0]
            if settings.real_time:
                time.sleep(max(0.0, start_s + task.simulation.dt - time.monotonic()))

        returns, lengths, truncated = play_episodes(agent.stepper, step)
        mean_length = lengths.double().mean()
        sys.stdout.write(
            f"episodes: {len(returns)}, {int(truncated.sum())} to the time limit\n"
            f"return: mean {returns.mean():.2f}, min {returns.min():.2f}, max {returns.max():.2f}\n"
            f"length: mean {mean_length:.1f}, min {lengths.min()}, max {lengths.max()}\n"
        )
        sys.stdout.flush()
        with suppress(KeyboardInterrupt):
            while task.is_watched:
                step()


def _date() -> str:
    return datetime.now().strftime("%Y-%m-%d_%H-%M-%S-%f")


def _interrupt() -> None:
    """Raise Ctrl-C's exception after the window was closed, to end the program."""
    raise KeyboardInterrupt


@contextmanager
def _session(
    library: str,
    name: str,
    words: Sequence[str],
    content: dict[str, Any],
    checkpoint: Path | None,
    *,
    plays: bool = False,
) -> Iterator[tuple[Agent, dict[str, Any], Viewers]]:
    """Seed the random generators and make a task with its agent; close the task at the end.

    Args:
        library: name of the library.
        name: name or path of a task file.
        words: settings of the task as on train.py's command line.
        content: content of the agent file.
        checkpoint: checkpoint to load, or None.
        plays: True to play the agent, False to train the agent.

    Yields:
        The agent, the task's configuration as plain values, and viewers that are not started yet.
    """
    agent_seed = read_keys(SeedSettings, content, "agent").seed
    cfg = compose_task(name, [f"seed={agent_seed}", *words])
    settings = check_config(cfg)
    viewers = Viewers(dataclasses.replace(settings, test=plays))
    seed = resolve_seed(settings.seed, settings.torch_deterministic)
    seed_everything(seed, settings.torch_deterministic)
    device = settings.rl_device
    task = make_from_config(
        cfg, sim_device=settings.sim_device, rl_device=device, graphics_device_id=-1
    )
    env = {
        "task": OmegaConf.to_container(cfg.task, resolve=True),
        "seed": seed,
        "rl_device": device,
    }
    try:
        agent = _make_agent(library, task, content, device, seed)
        rows = task.num_envs if plays else agent.minibatch_rows
        parameters = (part for network in agent.networks for part in network.parameters())
        products = rows * sum(part.numel() for part in parameters)
        limit_torch_threads(task, threads_for_products(products), settings.num_threads)
        if checkpoint is not None:
            agent.load(checkpoint)
        yield agent, env, viewers
    finally:
        viewers.close()
        task.close()


def _make_agent(
    library: str, task: VecTask, content: dict[str, Any], device: str, seed: int
) -> Agent:
    """Import the library and make an agent.

    Raises:
        ConfigError: the library refuses a value.
    """
    module = importlib.import_module(f"isaacgymenvs_lite.workflows.{library}.agent")
    try:
        return module.Agent(task, content, device, seed)
    except UserError:
        raise
    except (TypeError, ValueError, AssertionError, AttributeError, LookupError) as error:
        message = f"agent: {library} refuses the values: {one_line(error)}"
        raise ConfigError(message) from error


def _write_params(folder: Path, files: dict[str, dict[str, Any]]) -> None:
    """Write the configuration of a training into its new folder."""
    try:
        (folder / "params").mkdir(parents=True)
        for name, content in files.items():
            text = yaml.safe_dump(content, sort_keys=False)
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"cannot write the log folder {folder.absolute()} ({error.strerror or error}); choose"
            " another with logs=FOLDER"
        ) from error


def find_checkpoint(library: str, settings: CommandSettings) -> Path:
    """Return the checkpoint that the command line names, or the task's newest checkpoint."""
    if settings.checkpoint not in ("", LAST):
        checkpoint = user_path(settings.checkpoint)
        if not checkpoint.is_file():
            raise CheckpointError(f"checkpoint={checkpoint}: no such file")
        return checkpoint
    folder = Path(settings.logs) / library / settings.name
    files = [file for file in folder.rglob("*") if file.suffix in _CHECKPOINTS]
    if not files:
        command = package_command("workflows", library, "train")
        raise CheckpointError(
            f"no checkpoint below {folder.absolute()}; train one first, or give checkpoint=FILE:"
            f" {command} task={settings.name}"
        )
    return max(files, key=lambda file: file.stat().st_mtime)


def play_episodes(
    stepper: AutoresetTask, step: Callable[[], None]
) -> tuple[Tensor, Tensor, Tensor]:
    """Step until each environment has ended an episode; measure each environment's first episode.

    The number of steps is not fixed, because the episodes that end within a fixed number of steps
    are shorter than the average episode.

    Returns:
        (N,) sums of rewards, (N,) control steps, and (N,) bool, whether the time limit ended the
        episode.
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
    return returns, lengths, truncated
