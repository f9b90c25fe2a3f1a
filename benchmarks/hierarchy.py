"""Measures the levels of a hierarchy by the fixed protocol.

    python -m benchmarks.hierarchy skills TARGET [TARGET ...] [key=value ...]
    python -m benchmarks.hierarchy getup TARGET [TARGET ...] [key=value ...]
    python -m benchmarks.hierarchy goal TARGET [TARGET ...] [key=value ...]
        [--runs-dir runs/benchmarks] [--random-latents] [--write]

`skills` plays low-level controllers under latents as in training: which clips of the data set their
motion is nearest to, what the encoder makes of it, how many episodes end without a fall. `getup`
plays low-level controllers of HumanoidASEGetup from the
ground: the share of characters that are up within 3 s, and stay up until 6 s. `goal` plays policies
on a task: the task's return, 1 for the full reward in every step.

Targets are those of `benchmarks.evaluate`. 128 episodes of up to 300 steps from the default pose,
the same goals for all policies; mean actions. `--random-latents` plays a hierarchy's low level
without its high level. `--write` adds the numbers to benchmarks/results.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks.evaluate import RESULTS_DIR
from benchmarks.played import append_result, find_targets
from benchmarks.protocol import IMITATION_SETTINGS, SEED, play_checkpoint
from benchmarks.runs import DEFAULT_RUNS_DIR
from isaacgymenvs_lite.checkpoints.llc_reference import SHIPPED_LLC
from isaacgymenvs_lite.errors import CheckpointError, ConfigError, UserError
from isaacgymenvs_lite.evaluation.evaluate import evaluate
from isaacgymenvs_lite.learning.skills.latents import sample_latents
from isaacgymenvs_lite.learning.skills.low_level_policy import LowLevelPolicy, LowLevelSizes

EPISODES = 128
GETUP_S = 3.0
CONTROL_STEPS_PER_S = 30
LLC_CONFIG = "HumanoidASEPPO"
"""Train file of the shipped low level, which judges the style of policies without one."""


@dataclass(frozen=True, kw_only=True)
class Skills:
    """What a low-level controller can do.

    Attributes:
        coverage: share of the clips that are the nearest to at least 1 % of the windows.
        clip_shares: clip -> share of the windows.
        encoder_reward: mean over the windows.
        shuffled_reward: the same for latents of other episodes and times.
        no_fall_share: of the episodes.
    """

    coverage: float
    clip_shares: dict[str, float]
    encoder_reward: float
    shuffled_reward: float
    no_fall_share: float

    def __str__(self) -> str:
        return (
            f"coverage {self.coverage:.2f}, encoder reward {self.encoder_reward:.3f}"
            f" ({self.shuffled_reward:.3f} shuffled), without a fall {self.no_fall_share:.2f}"
        )


@dataclass(frozen=True, kw_only=True)
class GotUp:
    """How well a low-level controller gets up.

    Attributes:
        got_up_share: of the episodes: stood on its feet after `GETUP_S`, and until the end.
    """

    got_up_share: float

    def __str__(self) -> str:
        return f"got up within {GETUP_S:g} s and stayed up: {self.got_up_share:.2f}"


@dataclass(frozen=True, kw_only=True)
class GoalReached:
    """How well a policy does what it is asked to.

    Attributes:
        task_return: sum of the task's rewards of an episode over the number of its steps when
            nothing ends it early, mean over the episodes.
        no_fall_share: of the episodes.
        style_reward: what the discriminator of a low level pays per control step: the policy's own,
            or, for a policy without one, of the shipped low level; None if that is of another
            humanoid.
    """

    task_return: float
    no_fall_share: float
    style_reward: float | None

    def __str__(self) -> str:
        text = f"task return {self.task_return:.3f}, without a fall {self.no_fall_share:.2f}"
        if self.style_reward is None:
            return text
        return f"{text}, style reward {self.style_reward:.3f} per step"


def fixed_settings(kind: str) -> dict[str, Any]:
    """Return what differs from the protocol of imitation, for a kind of measurement."""
    own = {
        "num_envs": EPISODES,
        "task.env.numEnvs": EPISODES,
        "task.env.stateInit": "Default",
        "task.env.fallInitProb": 0.0,
        "task.env.recoveryEpisodeProb": 0.0,
    }
    if kind == "getup":
        own |= {
            "task.env.fallInitProb": 1.0,
            "task.env.recoverySteps": round(GETUP_S * CONTROL_STEPS_PER_S),
            "task.env.episodeLength": 2 * round(GETUP_S * CONTROL_STEPS_PER_S),
        }
    return {**IMITATION_SETTINGS, **own}


def measure_skills(player: Any, env: Any) -> Skills:
    """Play a low-level controller; see the module docstring.

    Raises:
        ConfigError: it is none.
    """
    if not hasattr(player, "skills"):
        raise ConfigError("skills: expected a policy of algo: name: gen_amp or ase")
    del env
    player.games_num = EPISODES
    player.run()
    found, imitation = player.skills, player.result.imitation
    return Skills(
        coverage=found.clips.coverage if found else 0.0,
        clip_shares=found.clips.shares if found else {},
        encoder_reward=found.encoder_reward if found else 0.0,
        shuffled_reward=found.shuffled_reward if found else 0.0,
        no_fall_share=imitation.no_fall_share,
    )


def measure_getup(player: Any, env: Any) -> GotUp:
    """Play a low-level controller from the ground; see the module docstring.

    Raises:
        ConfigError: its task has no fallen starts.
    """
    if not hasattr(env, "fallen_root_states"):
        raise ConfigError(f"getup: {type(env).__name__} never lies; train task=HumanoidASEGetup")
    return GotUp(got_up_share=measure_skills(player, env).no_fall_share)


def measure_goal(player: Any, env: Any, random_latents: bool = False) -> GoalReached:
    """Play a policy on the task of its run; see the module docstring.

    Raises:
        ConfigError: random latents for a policy without a low level.
    """
    policy = _policy(player, random_latents)
    judge = getattr(player, "llc", None) or shipped_judge(env)
    style = None if judge is None else judge.style_reward
    result = evaluate(env, policy, EPISODES, style_reward=style)
    assert result.imitation is not None  # the task has reference motions
    # The step that ends an episode at the time limit is the one before the last.
    full = env.max_episode_length - 1
    return GoalReached(
        task_return=result.reward / full,
        no_fall_share=result.imitation.no_fall_share,
        style_reward=result.style_reward,
    )


def shipped_judge(env: Any) -> LowLevelPolicy | None:
    """Return the shipped low level, whose discriminator rates the style; None if it misfits."""
    try:
        return LowLevelPolicy(LLC_CONFIG, SHIPPED_LLC, LowLevelSizes.from_task(env), env.rl_device)
    except CheckpointError:  # of another humanoid
        return None


def _policy(player: Any, random_latents: bool) -> Callable[[dict[str, torch.Tensor]], torch.Tensor]:
    if not random_latents:
        return player.act
    llc = getattr(player, "llc", None)
    if llc is None:
        raise ConfigError("--random-latents: expected a policy of algo: name: hrl")
    act = llc.policy_under(
        lambda obs: sample_latents(len(obs), llc.latent_dim, obs.device), player.llc_steps
    )
    return lambda obs: act(player.obs_to_torch(obs)["obs"])


def main(words: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("kind", choices=["skills", "getup", "goal"])
    parser.add_argument("what", nargs="+", help="checkpoints, run folders, experiments, overrides")
    parser.add_argument("--runs-dir", type=Path, default=DEFAULT_RUNS_DIR)
    parser.add_argument("--random-latents", action="store_true")
    parser.add_argument("--evaluation-seed", type=int, default=SEED)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--write", action="store_true", help="add the numbers to --results-dir")
    parser.add_argument("--results-dir", type=Path, default=RESULTS_DIR)
    args = parser.parse_intermixed_args(words)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    if args.random_latents and args.kind != "goal":
        sys.exit("error: --random-latents belongs to goal")
    measures = {
        "skills": measure_skills,
        "getup": measure_getup,
        "goal": partial(measure_goal, random_latents=args.random_latents),
    }
    try:
        for run, checkpoint in find_targets(args.what, args.runs_dir):
            found = play_checkpoint(
                checkpoint,
                measures[args.kind],
                fixed_settings(args.kind),
                args.evaluation_seed,
                num_threads=args.threads,
                overrides=tuple(word for word in args.what if "=" in word),
            )
            print(f"{run.label}: {found}", flush=True)
            if args.write:
                name = f"{run.experiment}{'+random_latents' if args.random_latents else ''}"
                append_result(
                    args.results_dir, name, run, checkpoint, found, args.evaluation_seed, EPISODES
                )
    except UserError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
