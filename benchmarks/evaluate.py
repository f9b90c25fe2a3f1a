"""Measures trained policies by the fixed protocol.

    python -m benchmarks.evaluate TARGET [TARGET ...] [key=value ...]
        [--runs-dir runs/benchmarks] [--epoch N] [--episodes 32] [--write] [--markdown]

A target is a checkpoint, a run folder (its newest checkpoint), or the name of an experiment (the
newest checkpoint of each of its seeds). 32 episodes of up to 300 steps, one in each environment,
from random moments of the clip, the same for every policy; mean actions. `--episodes` plays more,
where 32 are too few: four falls can be 5% as well as 20%. Prints one line for each
policy and the medians over seeds; `--write` adds the records to benchmarks/results.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.learned import first_learned
from benchmarks.learning_curve import read_learning_curve
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
from benchmarks.runs import DEFAULT_RUNS_DIR, Run, find_runs, plain
from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from isaacgymenvs_lite.errors import CheckpointError, ConfigError, UserError

RESULTS_DIR = Path(__file__).with_name("results")


def measure(
    run: Run,
    checkpoint: Path | None = None,
    seed: int = SEED,
    num_threads: int = 1,
    overrides: Sequence[str] = (),
    episodes: int = EPISODES,
) -> Record:
    """Play a checkpoint of a run, by default the newest, and gather what is known about it.

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
    """Shorten `task.env.motion_file=/home/me/walk.npy`: the folder says nothing elsewhere."""
    key, _, value = setting.partition("=")
    return f"{key}={Path(value.strip(chr(39))).name}" if key.endswith("motion_file") else setting


def evaluate_and_report(
    runs: Sequence[Run],
    checkpoints: Sequence[Path | None] | None = None,
    results_dir: Path | None = None,
    markdown: bool = False,
    seed: int = SEED,
    num_threads: int = 1,
    overrides: Sequence[str] = (),
    episodes: int = EPISODES,
) -> list[Record]:
    """Measure checkpoints, print a line for each and the medians, write the records if asked to.

    Args:
        runs: what to measure.
        checkpoints: one for each run; None for the newest.
        results_dir: where records and learning curves are written; None writes none.
        markdown: print a table for docs/, too.
        seed: of the episodes' starts.
        num_threads: for physics and networks.
        overrides: settings that replace the runs'.
        episodes: how many of each policy.

    Raises:
        UserError: a run cannot be measured.
    """
    records = []
    for run, checkpoint in zip(runs, checkpoints or [None] * len(runs), strict=True):
        records.append(measure(run, checkpoint, seed, num_threads, overrides, episodes))
        keep(run, records[-1], results_dir)
    print_medians(records)
    if markdown:
        print(markdown_table(records))
    return records


def keep(run: Run, record: Record, results_dir: Path | None) -> None:
    """Print the record of a run, and write it and the learning curve into a folder, if any."""
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
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", nargs="+", help="checkpoints, run folders, experiments, overrides")
    parser.add_argument("--runs-dir", type=Path, default=DEFAULT_RUNS_DIR)
    parser.add_argument("--epoch", type=int, help="the checkpoint of an epoch, not the newest")
    parser.add_argument("--evaluation-seed", type=int, default=SEED)
    parser.add_argument("--episodes", type=int, default=EPISODES, help="of each policy")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--write", action="store_true", help="add the records to --results-dir")
    parser.add_argument("--results-dir", type=Path, default=RESULTS_DIR)
    parser.add_argument("--markdown", action="store_true", help="print a table, too")
    args = parser.parse_intermixed_args()
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        targets = [word for word in args.what if "=" not in word]
        if not targets:
            raise ConfigError("give a checkpoint, a run folder or an experiment")
        runs, checkpoints = _find(targets, args.runs_dir, args.epoch)
        evaluate_and_report(
            runs,
            checkpoints,
            args.results_dir if args.write else None,
            args.markdown,
            args.evaluation_seed,
            args.threads,
            [word for word in args.what if "=" in word],
            args.episodes,
        )
    except UserError as error:
        sys.exit(f"error: {error}")


def _find(
    targets: Sequence[str], runs_dir: Path, epoch: int | None
) -> tuple[list[Run], list[Path | None]]:
    """Return the runs of the targets, and the checkpoint asked for of each."""
    runs: list[Run] = []
    checkpoints: list[Path | None] = []
    for target in targets:
        if target.endswith(".pth"):
            runs.append(Run.at(Path(target).absolute().parent.parent))
            checkpoints.append(Path(target))
            continue
        for run in find_runs(target, runs_dir):
            runs.append(run)
            checkpoints.append(None if epoch is None else run.checkpoint_of_epoch(epoch))
    return runs, checkpoints


if __name__ == "__main__":
    main()
