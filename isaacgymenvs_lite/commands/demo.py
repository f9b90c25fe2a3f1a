"""Plays the shipped policies and records videos: isaacgymenvs-lite demo [key=value ...].

    isaacgymenvs-lite demo                            # asks for policies; demo/<name>.mp4
    isaacgymenvs-lite demo policies=[walk] seconds=10
    isaacgymenvs-lite demo format=webp seconds=2      # a small animated picture
    isaacgymenvs-lite demo format=png seconds=1       # a picture of eight poses

The video of an imitating policy shows the reference clip on the left (above in a .png) and the
policy on the right. The pose error is the mean over 16 episodes of 10 s, which start at random
times of the clip; the video shows the first episode. The video of any other policy shows the first
three of 16 episodes, and the goals. Policies with skills start from the default pose. Without a
terminal the command plays all policies whose clips are installed.
"""

from __future__ import annotations

import argparse
import logging
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from omegaconf import DictConfig

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.checkpoints.packed import PolicyInfo, shipped_policy_infos
from isaacgymenvs_lite.checkpoints.policy_arguments import playing_overrides
from isaacgymenvs_lite.command_line import run_command
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_interface import ReferenceEnv, fits
from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.evaluation.evaluate import EvaluationResult, evaluate
from isaacgymenvs_lite.motion.strip import draw_poses, save_png
from isaacgymenvs_lite.rendering.gl import ensure_gl
from isaacgymenvs_lite.rendering.markers import Marker
from isaacgymenvs_lite.rendering.tracks import PoseRecorder, Track
from isaacgymenvs_lite.rendering.video import draw_tracks, save_video
from isaacgymenvs_lite.rendering.view import has_free_root
from isaacgymenvs_lite.runner import load_player
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.viewers.reference_overlay import reference_track

log = logging.getLogger(__name__)

_EPISODES = 16
_EPISODE_STEPS = 300
_SEED = 1
# Networks of policies that do not imitate a clip, and the number of episodes in their videos.
_SKILL_NETWORKS = ("gen_amp", "ase", "hrl")
_SHOWN_EPISODES = 3
_POSES_OF_A_STRIP = 8
# The policies in the README, which come first in lists of policies.
_BEST_FIRST = (
    *("backflip", "spinkick", "g1_walk", "walk", "heading", "strike", "reach", "cartwheel", "run"),
    *("g1_velocity", "franka_cabinet", "franka_cube_stack", "allegro_hand", "getup"),
    *("locomotion_skills", "anymal", "humanoid", "ant"),
)
# Width and height of a panel in pixels, and number of control steps from frame to frame.
_SIZES = {"mp4": (320, 480, 1), "webp": (200, 300, 2)}


@dataclass(frozen=True, kw_only=True)
class DemoSettings:
    """Arguments of the command."""

    policies: tuple[str, ...] = setting([])
    """Names of shipped policies. If it is [], the terminal's user chooses; else all are played."""
    seconds: float = setting(5.0, above=0, maximum=60)
    """Length of the video in s."""
    format: str = setting("mp4", choices=(*_SIZES, "png"))
    """mp4, webp (animated) or png (a strip of poses)."""
    out: str = setting("demo")
    """Folder for the files, which is made if it does not exist."""


@dataclass(frozen=True)
class Performance:
    """The recording of a policy.

    Attributes:
        model: model of the character.
        dt_s: control step in s.
        tracks: a track (T, nq) for each panel. The panels show the clip and the policy with the
            same phase, or the policy in several environments.
        labels: labels of the tracks, or an empty sequence.
        markers: markers at each time of each track, for example goals, or an empty sequence.
        summary: a sentence about the result over all environments.
    """

    model: mujoco.MjModel
    dt_s: float
    tracks: Sequence[Track]
    labels: Sequence[str]
    markers: Sequence[Sequence[Sequence[Marker]]]
    summary: str


def run_demo(settings: DemoSettings) -> list[Path]:
    """Play, measure and record policies; return the path of a video for each policy.

    Raises:
        UserError: a policy is unknown, this machine cannot draw or encode, or the folder cannot be
            written.
    """
    names = _names(settings.policies)
    ensure_gl()  # An error should come before the policies are played.
    folder = Path(settings.out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"out={settings.out}: cannot be made ({error.strerror})") from error
    files = []
    for number, name in enumerate(names, start=1):
        log.info("%s, %d of %d: playing and drawing", name, number, len(names))
        performance = perform(name, settings.seconds)
        path = save_performance(performance, folder / f"{name}.{settings.format}")
        log.info("%s: %s", name, performance.summary)
        log.info("%s: wrote %s, %.0f KiB", name, path, path.stat().st_size / 1024)
        files.append(path)
    return files


def _names(wanted: Sequence[str]) -> list[str]:
    """Return the wanted policies, the policies that the user chooses, or all playable policies."""
    shipped = shipped_policy_infos()
    known = [name for name in _BEST_FIRST if name in shipped]
    infos = {name: shipped[name] for name in (*known, *shipped)}
    if not infos:
        raise ConfigError(
            f"there is no policy in {paths.shipped_policies_dir()}; pack one with python -m"
            " isaacgymenvs_lite policies pack checkpoint=FILE name=NAME"
        )
    if not wanted and sys.stdin.isatty():
        wanted = ask(infos)
    for name in wanted:
        if name not in infos:
            raise ConfigError(unknown("policy", name, infos))
    if wanted:
        return list(wanted)
    names = []
    for name, info in infos.items():
        if missing := info.missing():
            log.info("%s is left out: %s", name, missing)
        else:
            names.append(name)
    return names


def ask(infos: Mapping[str, PolicyInfo]) -> list[str]:
    """List the policies in a terminal and return the user's choice, or [] if it is all."""
    numbers = {str(number): name for number, name in enumerate(infos, start=1)}
    for number, name in numbers.items():
        sys.stdout.write(f"{number:>4}  {name:20}{infos[name]}\n")
    try:
        words: list[str] = re.findall(
            r"[^\s,]+", input("Which ones, by number or name? Enter: all  ")
        )
    except EOFError:
        return []
    return [numbers.get(word, word) for word in words]


def perform(name: str, seconds: float) -> Performance:
    """Play a shipped policy with its mean actions, and record the motion.

    The recording is shorter than `seconds` if the episodes of all environments end earlier.

    Raises:
        UserError: the policy cannot be played.
    """
    cfg, num_steps = _tree(name, seconds)
    with load_player(cfg) as player:
        env = player.env
        model, dt_s = env.simulation.model, env.control_dt_s
        has_goal = env.get_task_obs_size() > 0
        imitates = not has_goal and not _has_skills(cfg) and fits(env, ReferenceEnv)
        recorder = PoseRecorder(env, num_steps, range(1 if imitates else _SHOWN_EPISODES))
        result = evaluate(env, player.act, env.num_envs, on_step=lambda *_: recorder.step())
        tracks = recorder.tracks()
        if imitates:
            tracks.insert(0, reference_track(env, tracks[0]))
            labels, markers = ("reference clip", "policy"), []
            summary = f"{result.num_episodes} episodes: {result.imitation}"
        else:
            labels, markers = (), recorder.markers()
            summary = _summary(result, cfg)
        return Performance(model, dt_s, tracks, labels, markers, summary)


def _tree(name: str, seconds: float) -> tuple[DictConfig, int]:
    """Return a configuration that plays a policy, and the number of control steps to record."""
    fixed = (
        "test=True",
        f"checkpoint={name}",
        f"num_envs={_EPISODES}",
        f"seed={_SEED}",
        "rl_device=cpu",
        "num_threads=1",  # With few humanoids several threads are slower than one thread.
    )
    cfg = compose([*playing_overrides(name), *fixed])
    env = cfg.task.env
    num_steps = max(1, round(seconds / (cfg.task.sim.dt * env.controlFrequencyInv)))
    if "stateInit" in env:  # The task has reference motions.
        env.stateInit = "Default" if _has_skills(cfg) else "Random"
        env.episodeLength = max(_EPISODE_STEPS, num_steps + 1)
    if "fallInitProb" in env:  # The policy can get up.
        env.fallInitProb, env.recoveryEpisodeProb = 1.0, 0.0
    return cfg, num_steps


def _has_skills(cfg: DictConfig) -> bool:
    return cfg.train.params.network.name in _SKILL_NETWORKS


def _summary(result: EvaluationResult, cfg: DictConfig) -> str:
    parts = [f"{name.replace('_', ' ')} {mean:.2f}" for name, mean in result.successes.items()]
    if result.imitation is None:  # The task has no reference motion.
        return ", ".join((*parts, f"return {result.reward:.1f} in {result.steps:.0f} steps"))
    parts += [f"{name} {error:.3f}" for name, error in result.goal_errors.items()]
    if cfg.train.params.network.name == "hrl":  # Policies with random skills have no task reward.
        parts.append(f"task reward {result.reward / result.steps:.2f} per step")
    return ", ".join((*parts, result.imitation.falls()))


def save_performance(performance: Performance, path: Path) -> Path:
    """Write a recording as a video (.mp4, .webp) or as a strip of poses (.png).

    Raises:
        UserError: the file cannot be drawn, encoded or written.
    """
    tracks = performance.tracks
    kind = path.suffix.removeprefix(".")
    if kind == "png":
        times = np.linspace(0, len(tracks[0]), _POSES_OF_A_STRIP, endpoint=False)
        rows = [draw_poses(performance.model, track[times.astype(int)]) for track in tracks]
        return save_png(path, np.concatenate(rows))
    width, height, stride = _SIZES[kind]
    if not has_free_root(performance.model):  # an arm is not as narrow as a person
        width, height = height, width
    images = draw_tracks(
        performance.model,
        [track[::stride] for track in tracks],
        performance.labels,
        markers=performance.markers[::stride],
        width=width,
        height=height,
    )
    return save_video(path, images, 1.0 / (performance.dt_s * stride))


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="isaacgymenvs-lite demo", description=__doc__)
    return run_command(parser, DemoSettings, run_demo, arguments)


if __name__ == "__main__":
    sys.exit(main())
