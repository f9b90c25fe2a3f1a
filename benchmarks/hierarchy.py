"""Measures the levels of a hierarchy by the fixed protocol.

    python -m benchmarks.hierarchy skills TARGET [TARGET ...] [key=value ...]
    python -m benchmarks.hierarchy clips TARGET [TARGET ...] [key=value ...]
    python -m benchmarks.hierarchy getup TARGET [TARGET ...] [key=value ...]
    python -m benchmarks.hierarchy goal TARGET [TARGET ...] [key=value ...]
        [--runs-dir runs/benchmarks] [--random-latents] [--write]

`skills` plays low-level controllers with random latents, which are drawn as in training. It
measures which clips of the data set the motion resembles, the reward of the encoder, and the share
of episodes without a fall. `clips` plays them with the mean latent of each clip, and counts the
clips whose pace they follow. `getup` plays low-level controllers of HumanoidASEGetup from the
ground. It measures the share of episodes in which the humanoid stands after 3 s and until 6 s.
`goal` plays policies on a task. It measures the task's return, which is 1 for the full reward in
every step, and its success.

`benchmarks.evaluate` describes the targets. Each policy plays 128 episodes of up to 300 steps from
the default pose, with mean actions and with the same goals. `--random-latents` replaces the high
level of a hierarchy by random latents. `--write` adds the results to benchmarks/results.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from benchmarks.played import append_result, find_targets, parser_of
from benchmarks.protocol import IMITATION_SETTINGS, play_checkpoint
from isaacgymenvs_lite.checkpoints.llc_reference import SHIPPED_LLC
from isaacgymenvs_lite.errors import CheckpointError, ConfigError, UserError
from isaacgymenvs_lite.evaluation.evaluate import evaluate
from isaacgymenvs_lite.evaluation.skill_pace import ClipPaces
from isaacgymenvs_lite.learning.skills.latents import sample_latents
from isaacgymenvs_lite.learning.skills.low_level_policy import LowLevelPolicy, LowLevelSizes

EPISODES = 128
GETUP_S = 3.0
CONTROL_STEPS_PER_S = 30
LLC_CONFIG = "HumanoidASEPPO"
"""The shipped low level has this train file. It rates the style of policies without a low level."""


@dataclass(frozen=True, kw_only=True)
class Skills:
    """Skills of a low-level controller, measured over short windows of its motion.

    Attributes:
        coverage: share of the clips that are the nearest clip of at least 1 % of the windows.
        clip_shares: clip -> share of the windows to which the clip is nearest.
        encoder_reward: mean encoder reward of the windows.
        shuffled_reward: mean encoder reward with latents of other episodes and times.
        no_fall_share: share of the episodes without a fall.
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
    """Success of a low-level controller at getting up.

    Attributes:
        got_up_share: share of the episodes with a standing humanoid from `GETUP_S` until the end.
    """

    got_up_share: float

    def __str__(self) -> str:
        return f"got up within {GETUP_S:g} s and stayed up: {self.got_up_share:.2f}"


@dataclass(frozen=True, kw_only=True)
class GoalReached:
    """Success of a policy on its task.

    Attributes:
        task_return: mean over the episodes of the summed task rewards, divided by the number of
            steps of a full episode.
        no_fall_share: share of the episodes without a fall.
        style_reward: mean discriminator reward per control step. The discriminator belongs to the
            policy's low level, or else to the shipped low level. None if the shipped low level is
            for another humanoid.
        successes: means of `Goal.successes` at the ends of the episodes.
    """

    task_return: float
    no_fall_share: float
    style_reward: float | None
    successes: dict[str, float]

    def __str__(self) -> str:
        text = f"task return {self.task_return:.3f}, without a fall {self.no_fall_share:.2f}"
        for name, share in self.successes.items():
            text += f", {name.replace('_', ' ')} {share:.2f}"
        if self.style_reward is None:
            return text
        return f"{text}, style reward {self.style_reward:.3f} per step"


def fixed_settings(kind: str) -> dict[str, Any]:
    """Return the settings of a kind of measurement, as path in the tree -> value."""
    own = {
        "num_envs": EPISODES,
        "task.env.numEnvs": EPISODES,
        "task.env.stateInit": "Default",
        "task.env.fallInitProb": 0.0,
        "task.env.recoveryEpisodeProb": 0.0,
    }
    if kind == "clips":
        own["latent"] = "clips"
    if kind == "getup":
        own |= {
            "task.env.fallInitProb": 1.0,
            "task.env.recoverySteps": round(GETUP_S * CONTROL_STEPS_PER_S),
            "task.env.episodeLength": 2 * round(GETUP_S * CONTROL_STEPS_PER_S),
        }
    return {**IMITATION_SETTINGS, **own}


def measure_skills(player: Any, env: Any) -> Skills:
    """Play a low-level controller, see the module docstring.

    Raises:
        ConfigError: the policy is no low-level controller.
    """
    if not hasattr(player, "skills"):
        raise ConfigError("skills: expected a policy with algo.name gen_amp or ase")
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


def measure_clips(player: Any, env: Any) -> ClipPaces:
    """Play a low-level controller with latents of clips, see the module docstring.

    Raises:
        ConfigError: the policy is no low-level controller, or nobody stays up for long enough.
    """
    measure_skills(player, env)
    if player.paces is None:
        raise ConfigError("clips: no episode was longer than two seconds")
    return player.paces


def measure_getup(player: Any, env: Any) -> GotUp:
    """Play a low-level controller from the ground, see the module docstring.

    Raises:
        ConfigError: the task has no fallen starts.
    """
    if not hasattr(env, "fallen_root_states"):
        raise ConfigError(
            f"getup: {type(env).__name__} never starts on the ground; train task=HumanoidASEGetup"
        )
    return GotUp(got_up_share=measure_skills(player, env).no_fall_share)


def measure_goal(player: Any, env: Any, random_latents: bool = False) -> GoalReached:
    """Play a policy on the task of its run, see the module docstring.

    Raises:
        ConfigError: `random_latents` is set for a policy without a low level.
    """
    policy = _policy(player, random_latents)
    judge = getattr(player, "llc", None) or _shipped_low_level(env)
    style = None if judge is None else judge.style_reward
    result = evaluate(env, policy, EPISODES, style_reward=style)
    assert result.imitation is not None  # the task has reference motions
    # An episode without early termination has one step less than max_episode_length.
    full = env.max_episode_length - 1
    return GoalReached(
        task_return=result.reward / full,
        no_fall_share=result.imitation.no_fall_share,
        style_reward=result.style_reward,
        successes=result.successes,
    )


def _shipped_low_level(env: Any) -> LowLevelPolicy | None:
    """Return the shipped low level, or None if it is for another humanoid."""
    try:
        return LowLevelPolicy(LLC_CONFIG, SHIPPED_LLC, LowLevelSizes.from_task(env), env.rl_device)
    except CheckpointError:
        return None


def _policy(player: Any, random_latents: bool) -> Callable[[dict[str, torch.Tensor]], torch.Tensor]:
    if not random_latents:
        return player.act
    llc = getattr(player, "llc", None)
    if llc is None:
        raise ConfigError("--random-latents: expected a policy with algo.name hrl")
    act = llc.policy_under(
        lambda obs: sample_latents(len(obs), llc.latent_dim, obs.device), player.llc_steps
    )
    return lambda obs: act(player.obs_to_torch(obs)["obs"])


def main(words: list[str] | None = None) -> None:
    """Measure the policies and print the results."""
    parser = parser_of(__doc__, kinds=("skills", "clips", "getup", "goal"))
    parser.add_argument("--random-latents", action="store_true")
    args = parser.parse_intermixed_args(words)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    if args.random_latents and args.kind != "goal":
        sys.exit("error: --random-latents has an effect for goal only; leave it out")
    measures = {
        "skills": measure_skills,
        "clips": measure_clips,
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
