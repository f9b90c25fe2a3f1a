"""Measures trained policies by the fixed protocol.

    python -m benchmarks.evaluate TARGET [TARGET ...] [key=value ...]
        [--runs-dir runs/benchmarks] [--epoch N] [--episodes 32] [--write] [--markdown]

A target is a checkpoint, a run folder (its newest checkpoint), or the name of an experiment (the
newest checkpoint of each seed). Each policy plays 32 episodes of up to 300 steps with mean actions,
one episode in each environment. The episodes start at random phases of the clip, which are the same
for every policy. `--episodes` sets another number of episodes, because 32 episodes are a rough
measure. A policy with four falls of 32 may fall in 5% or in 20% of many episodes. The command
prints one line for each policy and the medians over the seeds. `--write` adds the records to
benchmarks/results.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.learned import first_learned
from benchmarks.learning_curve import read_learning_curve
from benchmarks.played import find_targets, parser_of
from benchmarks.protocol import EPISODES, SEED, evaluate_checkpoint
from benchmarks.records import (
    GOOD_EPISODE_STEPS,
    Record,
    by_experiment,
    markdown_table,
    medians,
    numbers_line,
    write_records,
)
from benchmarks.runs import Run, plain
from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from isaacgymenvs_lite.errors import CheckpointError, UserError


def measure(
    run: Run,
    checkpoint: Path | None = None,
    seed: int = SEED,
    num_threads: int = 1,
    overrides: Sequence[str] = (),
    episodes: int = EPISODES,
) -> Record:
    """Play a checkpoint of a run, by default the newest, and return its record.

    Raises:
        UserError: there is no checkpoint, or it cannot be played.
    """
    checkpoint = checkpoint or run.newest_checkpoint()
    if checkpoint is None:
        raise CheckpointError(f"{run.folder}: no checkpoint in nn/; train.py writes the first one")
    outcome = evaluate_checkpoint(checkpoint, seed, num_threads, tuple(overrides), episodes)
    state = load_checkpoint(checkpoint)
    curve = read_learning_curve(run.folder / "summaries")
    frames_to, minutes_to = curve["episode_length"].first_reach(GOOD_EPISODE_STEPS) or (None, None)
    learned_frames, learned_minutes = first_learned(run.experiment, curve) or (None, None)
    starts = run.starts()
    last = starts[-1] if starts else None
    frames = int(state.get("frame", 0))
    return Record(
        experiment=run.experiment,
        seed=run.seed,
        run=run.folder.resolve().name,
        checkpoint=checkpoint.name,
        frames=frames,
        epoch=int(state.get("epoch", 0)),
        minutes=curve.minutes_at(frames) if curve.minutes else None,
        minutes_to_280=minutes_to,
        frames_to_280=frames_to,
        minutes_to_learned=learned_minutes,
        frames_to_learned=learned_frames,
        pose_error_m=plain(outcome.imitation.pose_error_m),
        no_fall_share=outcome.imitation.no_fall_share,
        tempo=plain(outcome.imitation.tempo),
        motion_shown=plain(outcome.imitation.motion_shown),
        speed_m_s=plain(outcome.speed_m_s),
        clip_speed_m_s=outcome.clip_speed_m_s,
        goal_errors=outcome.goal_errors,
        mean_episode_steps=outcome.imitation.mean_episode_steps,
        num_episodes=outcome.imitation.num_episodes,
        evaluation_seed=seed,
        machine=last.machine if last else None,
        commit=", ".join(dict.fromkeys(start.commit for start in starts)) or None,
        cores=len(last.cores) if last else None,
        settings=[_without_folder(setting) for setting in last.settings] if last else None,
    )


def _without_folder(setting: str) -> str:
    """Return `task.env.motion_file=/home/me/walk.npy` without the folder."""
    key, _, value = setting.partition("=")
    return f"{key}={Path(value.strip(chr(39))).name}" if key.endswith("motion_file") else setting


def keep(record: Record, results_dir: Path | None) -> None:
    """Print a record, and write it if `results_dir` is given."""
    print(record, flush=True)
    if results_dir is not None:
        for file in write_records([record], results_dir):
            print(f"wrote {file}")


def print_medians(records: Sequence[Record]) -> None:
    """Print the medians over the seeds of each experiment that has several."""
    for experiment, group in by_experiment(records).items():
        if len(group) > 1:
            print(f"{experiment}, median of {len(group)}: {numbers_line(medians(group))}")


def main() -> None:
    """Measure the policies and print their records."""
    parser = parser_of(__doc__)
    parser.add_argument("--epoch", type=int, help="epoch of the checkpoint (default: the newest)")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="episodes of each policy")
    parser.add_argument("--markdown", action="store_true", help="print a Markdown table, too")
    args = parser.parse_intermixed_args()
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    overrides = [word for word in args.what if "=" in word]
    settings = (args.evaluation_seed, args.threads, overrides, args.episodes)
    records = []
    try:
        for run, checkpoint in find_targets(args.what, args.runs_dir, args.epoch):
            records.append(measure(run, checkpoint, *settings))
            keep(records[-1], args.results_dir if args.write else None)
        print_medians(records)
        if args.markdown:
            print(markdown_table(records))
    except UserError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
