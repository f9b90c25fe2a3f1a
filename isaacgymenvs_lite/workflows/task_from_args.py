"""The task that a workflow's command line asks for, and who watches it."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite.config.compose import compose_task
from isaacgymenvs_lite.config.devices import check_device
from isaacgymenvs_lite.config.launch import LaunchSettings, check_config, resolve_seed
from isaacgymenvs_lite.env_factory import make_from_config, seed_everything
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.utils.threads import limit_torch_threads, threads_for_products
from isaacgymenvs_lite.viewers.start import Viewers
from isaacgymenvs_lite.workflows.agent_files import PREFIX

# Words of train.py that count here as well; of the others some have a counterpart.
_TASK_WORDS = {
    *("seed", "num_envs", "torch_deterministic", "task"),
    *("sim_device", "rl_device", "pipeline", "num_threads"),
    *("headless", "force_render", "viewer", "viewer_port", "viewer_host"),
    *("capture_video", "capture_video_freq", "capture_video_len", "capture_video_envs"),
    *("physics_engine", "solver_type", "num_subscenes", "graphics_device_id"),
}
_COUNTERPARTS = {
    "max_iterations": "--max_iterations",
    "checkpoint": "--checkpoint",
    "train": f"--agent and {PREFIX}key=value",
    "experiment": "--logs",
    "full_experiment_name": "--logs",
    "test": "the command play",
    "task": "--task",
}


@dataclass(frozen=True)
class TaskSession:
    """A task as the command line asks for it.

    Attributes:
        task: the task.
        settings: what it is made of, as plain values.
        rl_device: torch device of the agent.
        seed: of the agent.
        num_threads: as the key; 0 for as many as pay.
        viewers: videos, window and page, once they are begun.
    """

    task: VecTask
    settings: dict[str, Any]
    rl_device: str
    seed: int
    num_threads: int
    viewers: Viewers

    def watch(self, folder: Path, prefix: str = "rl-video") -> None:
        """Begin to watch the task as the command line asks for.

        Args:
            folder: of the training, in which `videos/` is.
            prefix: of the names of videos.
        """
        self.viewers.start(self.task, folder, _interrupt, prefix)

    def fit_threads(self, rows: int, num_parameters: int) -> None:
        """Let torch compute on as many threads as pay, until the task is closed.

        Args:
            rows: that the networks are evaluated for at once.
            num_parameters: of the networks.
        """
        most = threads_for_products(rows * num_parameters)
        limit_torch_threads(self.task, most, self.num_threads)

    def close(self) -> None:
        """Finish what is being recorded, and free the task."""
        self.viewers.close()
        self.task.close()


def agent_words(args: argparse.Namespace) -> list[str]:
    """Return the overrides of the agent file."""
    return [word for word in args.overrides if word.startswith(PREFIX)]


def make_task(args: argparse.Namespace, seed: int, *, plays: bool) -> TaskSession:
    """Seed the generators and make the task that the command line asks for.

    Args:
        args: of `arguments.make_parser`.
        seed: unless the command line gives one.
        plays: whether an agent is played, not trained.

    Raises:
        UserError: what train.py would refuse, or a word that means nothing here.
    """
    words = [word for word in args.overrides if not word.startswith(PREFIX)]
    _check_words(words)
    own = [f"seed={seed if args.seed is None else args.seed}"]
    if args.num_envs is not None:
        own.append(f"num_envs={args.num_envs}")
    if args.device is not None:
        check_device(args.device, "--device")
        own.append(f"rl_device={args.device}")
    if (args.livestream or 0) > 0:
        own.append("viewer=web")
    cfg = compose_task(args.task, [*own, *words])
    settings = check_config(cfg)
    viewers = Viewers(_watched(settings, args, plays))
    seed = resolve_seed(settings.seed, settings.torch_deterministic)
    seed_everything(seed, settings.torch_deterministic)
    task = make_from_config(
        cfg, sim_device=settings.sim_device, rl_device=settings.rl_device, graphics_device_id=-1
    )
    return TaskSession(
        task, _plain(cfg, seed), settings.rl_device, seed, settings.num_threads, viewers
    )


def _check_words(words: Iterable[str]) -> None:
    """Refuse words of train.py's command line that only its own agents hear.

    Raises:
        ConfigError: there is one.
    """
    for word in words:
        path = word.lstrip("+~").partition("=")[0]
        root = path.partition(".")[0]
        if root in _TASK_WORDS and path != "task":  # keys of the task, but not another task
            continue
        here = _COUNTERPARTS.get(root)
        hint = f"use {here}" if here else f"expected task.key=value or {PREFIX}key=value"
        raise ConfigError(f"{word}: is no setting of another library's agent; {hint}")


def _watched(settings: LaunchSettings, args: argparse.Namespace, plays: bool) -> LaunchSettings:
    """Return the settings with --video and its lengths in them."""
    if args.video:
        # One video of a play is enough.
        every = 2**62 if plays else args.video_interval
        settings = dataclasses.replace(
            settings,
            capture_video=True,
            capture_video_len=args.video_length,
            capture_video_freq=every,
        )
    return dataclasses.replace(settings, test=plays)


def _plain(cfg: DictConfig, seed: int) -> dict[str, Any]:
    task = OmegaConf.to_container(cfg.task, resolve=True)
    return {"task": task, "seed": seed, "rl_device": str(cfg.rl_device)}


def _interrupt() -> None:
    """End as Ctrl-C does, because somebody closed the window."""
    raise KeyboardInterrupt
