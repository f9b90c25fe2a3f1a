"""Measures the levels of a hierarchy by the fixed protocol.

    python -m benchmarks.hierarchy skills TARGET [TARGET ...] [key=value ...]
    python -m benchmarks.hierarchy clips TARGET [TARGET ...] [key=value ...]
    python -m benchmarks.hierarchy getup TARGET [TARGET ...] [key=value ...]
    python -m benchmarks.hierarchy goal TARGET [TARGET ...] [key=value ...]
        [--runs-dir runs/benchmarks] [--random-latents] [--write]

`skills` plays low-level controllers under latents as in training: which clips of the data set their
motion is nearest to, what the encoder makes of it, how many episodes end without a fall. `clips`
plays each of them under latents of one clip after the other, and compares how fast the character
goes and turns with the clip. `getup` plays low-level controllers of HumanoidASEGetup from the
ground: the share of characters that are up within 3 s, and stay up until 6 s. `goal` plays policies
on a task: the task's return, 1 for the full reward in every step.

Targets are those of `benchmarks.evaluate`. 128 episodes of up to 300 steps from the default pose,
the same goals for all policies; mean actions. `--random-latents` plays a hierarchy's low level
without its high level. `--write` adds the numbers to benchmarks/results.
"""

from __future__ import annotations

import argparse
import logging
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks import tables
from benchmarks.evaluate import RESULTS_DIR
from benchmarks.played import append_result, find_targets
from benchmarks.protocol import IMITATION_SETTINGS, SEED, play_checkpoint
from benchmarks.runs import DEFAULT_RUNS_DIR
from isaacgymenvs_lite.checkpoints.llc_reference import SHIPPED_LLC
from isaacgymenvs_lite.errors import CheckpointError, ConfigError, UserError
from isaacgymenvs_lite.evaluation.evaluate import evaluate
from isaacgymenvs_lite.learning.skills.latents import sample_latents
from isaacgymenvs_lite.learning.skills.low_level_policy import LowLevelPolicy, LowLevelSizes
from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.tasks.goals.planar import facing, xy_in_heading_frame

EPISODES = 128
CLIP_STEPS, CLIP_STARTS = 150, 40
"""Control steps under latents of one clip, and after how many of them it is under way."""
MOVING_M_S = 0.3
"""A clip of this pace goes or turns, a slower one rests."""
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
class Pace:
    """How fast a character goes and turns, in the heading frame of its root.

    Attributes:
        forward: m/s.
        left: m/s.
        turn: degrees/s, to the left.
    """

    forward: float
    left: float
    turn: float

    def __str__(self) -> str:
        return f"{self.forward:.2f}, {self.left:.2f}, {self.turn:.0f}"

    @classmethod
    def of(cls, root_pos: torch.Tensor, root_rot: torch.Tensor, dt_s: float) -> Pace:
        """Return the means over roots (T, n, 3) m and (T, n, 4) xyzw of consecutive moments."""
        before, after = root_rot[:-1].flatten(0, 1), root_rot[1:].flatten(0, 1)
        travel_w = (root_pos[1:] - root_pos[:-1])[..., :2].flatten(0, 1)
        forward, left = (xy_in_heading_frame(before, travel_w).mean(dim=0) / dt_s).tolist()
        ahead, aside = xy_in_heading_frame(before, facing(after)).unbind(-1)
        turn = torch.atan2(aside, ahead).mean().rad2deg().item() / dt_s
        return cls(forward=forward, left=left, turn=turn)

    def distance(self, other: Pace) -> float:
        """Return the difference in m/s; 100 degrees/s count as 1 m/s."""
        pairs = (self.forward, other.forward), (self.left, other.left), (self.turn, other.turn)
        return math.hypot(*(w * (a - b) for w, (a, b) in zip((1.0, 1.0, 0.01), pairs, strict=True)))


@dataclass(frozen=True, kw_only=True)
class ClipSkill:
    """What a low-level controller does under latents of one clip.

    Attributes:
        clip: how fast the clip goes and turns.
        shown: how fast the character does.
        encoder_reward: mean of the steps.
        no_fall_share: of the characters.
    """

    clip: Pace
    shown: Pace
    encoder_reward: float
    no_fall_share: float


@dataclass(frozen=True, kw_only=True)
class ClipSkills:
    """What a low-level controller does under latents of each clip.

    Attributes:
        num_moving: clips that go or turn, at 0.3 m/s or more.
        num_followed: those of them where the character's pace is off by at most half of the clip's.
        clips: by the clips' names.
    """

    num_moving: int
    num_followed: int
    clips: dict[str, ClipSkill]

    @classmethod
    def of(cls, clips: dict[str, ClipSkill]) -> ClipSkills:
        """Count what is followed."""
        rest = Pace(forward=0.0, left=0.0, turn=0.0)
        moving = [of for of in clips.values() if of.clip.distance(rest) >= MOVING_M_S]
        followed = [of for of in moving if of.shown.distance(of.clip) <= of.clip.distance(rest) / 2]
        return cls(num_moving=len(moving), num_followed=len(followed), clips=clips)

    def __str__(self) -> str:
        columns = (
            "clip",
            "m/s forward, left, degrees/s",
            "shown",
            "encoder reward",
            "without a fall",
        )
        rows = []
        for name, of in self.clips.items():
            shares = f"{of.encoder_reward:.2f}", f"{of.no_fall_share:.2f}"
            rows.append((name, str(of.clip), str(of.shown), *shares))
        head = f"follows {self.num_followed} of the {self.num_moving} clips that go or turn"
        return f"{head}\n{tables.markdown(columns, rows)}"


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


def measure_clips(player: Any, env: Any) -> ClipSkills:
    """Play a low-level controller under latents of each clip; see the module docstring.

    Raises:
        ConfigError: it is none, or has more clips than there are episodes.
    """
    if not hasattr(player, "hold_latents"):
        raise ConfigError("clips: expected a policy of algo: name: gen_amp or ase")
    clips = env.motion_lib
    if clips.num_motions() > env.num_envs:
        raise ConfigError(
            f"clips: got a data set of {clips.num_motions()} clips, expected at most"
            f" {env.num_envs}, one for each episode; give a smaller one:"
            " task.env.motion_file=FILE.yaml"
        )
    own_clip = torch.arange(env.num_envs) % clips.num_motions()
    player.hold_latents(player.encoder.read(moments_of(env.windows_of_clips(), own_clip)))
    obs, roots, agreements = env.reset(), [], []
    stays_up = torch.ones(env.num_envs, dtype=torch.bool)
    for _ in range(CLIP_STEPS):
        obs, _, dones, infos = env.step(player.act(obs))
        found = player.encoder.read(infos["amp_obs"].to(player.device))
        agreements.append((found * player.current_latents).sum(dim=-1).cpu())
        roots.append(env.simulation.root_states[:, :7].cpu().clone())
        stays_up &= ~dones.bool().cpu()
    moving, agreement = torch.stack(roots[CLIP_STARTS:]), torch.stack(agreements[CLIP_STARTS:])
    skills = {}
    for clip in range(clips.num_motions()):
        of_clip = (own_clip == clip).nonzero().flatten()
        root = moving[:, of_clip]
        skills[Path(clips.get_motion(clip).name).stem] = ClipSkill(
            clip=_pace_of_clip(clips, clip, env.control_dt_s),
            shown=Pace.of(root[..., :3], root[..., 3:], env.control_dt_s),
            encoder_reward=agreement[:, of_clip].clamp(min=0.0).mean().item(),
            no_fall_share=stays_up[of_clip].float().mean().item(),
        )
    return ClipSkills.of(skills)


def moments_of(windows: list[torch.Tensor], clips: torch.Tensor) -> torch.Tensor:
    """Return a window (N, F) of clips (N,) each, evenly spread over the clip."""
    rows = torch.empty(len(clips), windows[0].shape[1])
    for clip, of_clip in enumerate(windows):
        (envs,) = (clips == clip).nonzero(as_tuple=True)
        rows[envs] = of_clip[torch.linspace(0, len(of_clip) - 1, len(envs)).long()].cpu()
    return rows


def _pace_of_clip(clips: MotionLib, clip: int, dt_s: float) -> Pace:
    times_s = torch.arange(0.0, float(clips.get_motion_length([clip])), dt_s)
    state = clips.get_motion_state(torch.full((len(times_s),), clip), times_s)
    return Pace.of(state.root_pos.cpu()[:, None], state.root_rot.cpu()[:, None], dt_s)


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
    parser.add_argument("kind", choices=["skills", "clips", "getup", "goal"])
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
