"""Trains experiments of the fixed protocol by the clock and records what they reached.

    python -m benchmarks.learning EXPERIMENT [EXPERIMENT ...] [key=value ...]
        [--seeds 1 2 3] [--minutes 150] [--motion-file PATH] [--parallel 1] [--resume]
    python -m benchmarks.learning clips [key=value ...] [--clips deepmimic shipped PATH ...]
        [--until-learned] ...

Each seed is one `train.py` process with a run folder of its own, `<experiment>_seed<n>`. With
`--parallel 2` two of them run at a time, each on its own half of the CPUs: compare those by frames,
not by minutes. At the end of its minutes, and at Ctrl-C, a run saves and ends; `--resume` goes on
with it, and minutes count together. When a run has ended, `benchmarks.evaluate`, of a classic task
`benchmarks.returns`, plays its policy and writes benchmarks/results/<experiment>.jsonl. `clips` is
one experiment for each clip, with seed 1 unless `--seeds` names others, in folders of their own;
`benchmarks.clips` prints their table. docs/protocol.md has the rest.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from benchmarks.clips import DEFAULT_CLIPS, clip_experiments, newest_records
from benchmarks.clips import NAME as CLIPS
from benchmarks.evaluate import RESULTS_DIR, keep, measure, print_medians
from benchmarks.experiments import find_experiment, needs_motion_file
from benchmarks.learned import has_learned, is_learned
from benchmarks.records import Record
from benchmarks.returns import measure_and_keep
from benchmarks.runs import DEFAULT_RUNS_DIR, Run
from benchmarks.training import Plan, log_file, plan, train_all
from isaacgymenvs_lite.errors import ConfigError, UserError
from isaacgymenvs_lite.run.stop_request import StopRequest


def main() -> None:
    """Train, then evaluate."""
    args = _parser().parse_intermixed_args()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        if CLIPS in args.what:
            args.runs_dir, args.results_dir = args.runs_dir / CLIPS, args.results_dir / CLIPS
        plans = _plans(args)
        slots = cpu_slots(args.parallel, args.cores_per_run)
        records: list[Record] = []

        def play(run: Run) -> None:
            if args.no_evaluation:
                return
            checkpoint = run.newest_checkpoint()
            if checkpoint is not None and not run.has_motions():
                measure_and_keep(run, checkpoint, args.results_dir)
                return
            records.append(measure(run))
            keep(run, records[-1], args.results_dir)

        with StopRequest() as stop:
            todo = [job for job in plans if job.minutes > 0]
            failed = train_all(todo, slots, lambda: stop.requested, on_end=play)
        for run in failed:
            print(f"{run.label} failed, the end of {log_file(run)}:")
            print("\n".join(log_file(run).read_text(encoding="utf-8").splitlines()[-5:]))
        if stop.requested:
            sys.exit("stopped; --resume goes on")
        for job in plans:
            if job.minutes == 0:  # had its time before
                play(job.run)
        print_medians(records)
    except UserError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:  # the second Ctrl-C
        sys.exit("stopped at once; --resume goes on")
    if failed:
        sys.exit(1)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", nargs="+", help="experiments, and overrides for train.py")
    parser.add_argument("--seeds", type=int, nargs="+", help="default: 1 2 3; of clips 1")
    parser.add_argument("--minutes", type=float, default=150.0, help="of each run, at most")
    parser.add_argument("--clips", nargs="+", help="of the experiment clips; see benchmarks.clips")
    parser.add_argument(
        "--until-learned", action="store_true", help="end a clip's training when it is learned"
    )
    parser.add_argument("--motion-file", help="the clip of experiments that leave it open")
    parser.add_argument("--parallel", type=int, default=1, help="runs at a time")
    parser.add_argument("--cores-per-run", type=int, help="default: all, shared by --parallel")
    parser.add_argument("--resume", action="store_true", help="go on with runs that exist")
    parser.add_argument("--runs-dir", type=Path, default=DEFAULT_RUNS_DIR)
    parser.add_argument("--results-dir", type=Path, default=RESULTS_DIR)
    parser.add_argument("--no-evaluation", action="store_true", help="train only")
    return parser


def _plans(args: argparse.Namespace) -> list[Plan]:
    """Return all runs, one seed of every experiment after the other.

    Raises:
        ConfigError: an experiment or a run cannot be used.
    """
    clips = [word for word in args.clips or () if "=" not in word]
    names = [word for word in args.what if "=" not in word]
    extra = [word for word in (*args.what, *(args.clips or ())) if "=" in word]
    if not names:
        raise ConfigError("give an experiment; benchmarks/experiments.yaml lists them")
    if args.motion_file and not any(needs_motion_file(name) for name in names):
        raise ConfigError(f"--motion-file has no effect: {', '.join(names)} have their own clips")
    for word, given in (("--clips", bool(clips)), ("--until-learned", args.until_learned)):
        if given and CLIPS not in names:
            raise ConfigError(f"{word} has no effect: {', '.join(names)}; add {CLIPS}")
    if CLIPS in names:
        return _plans_of_clips(names, clips or DEFAULT_CLIPS, args, extra)
    experiments = [find_experiment(name, args.motion_file, extra) for name in names]
    return [
        plan(experiment, Run.of(args.runs_dir, experiment.name, seed), args.minutes, args.resume)
        for seed in args.seeds or (1, 2, 3)
        for experiment in experiments
    ]


def _plans_of_clips(
    names: Sequence[str], clips: Sequence[str], args: argparse.Namespace, extra: Sequence[str]
) -> list[Plan]:
    """Return one run for each clip that is not done yet; without time if it lacks a record only.

    Raises:
        ConfigError: other experiments beside them, or a clip or a run cannot be used.
    """
    if len(names) > 1:
        raise ConfigError(f"{CLIPS} has folders of its own; give it alone, not {', '.join(names)}")
    experiments = clip_experiments(clips, extra)
    found = newest_records([each.name for each in experiments], args.results_dir)
    done = {(record.experiment, record.seed): record for of in found.values() for record in of}
    plans = []
    for seed in args.seeds or (1,):
        for each in experiments:
            run, record = Run.of(args.runs_dir, each.name, seed), done.get((each.name, seed))
            if args.until_learned and record is not None and is_learned(record):
                continue
            job = plan(each, run, args.minutes, args.resume)
            if args.until_learned:
                job = replace(job, is_over=partial(has_learned, each.name))
            if job.minutes > 0 or record is None:
                plans.append(job)
    return plans


def cpu_slots(parallel: int, cores_per_run: int | None = None) -> list[Sequence[int]]:
    """Return the CPUs of each of `parallel` places, none of them twice.

    Raises:
        ConfigError: there are not so many.
    """
    cores = sorted(os.sched_getaffinity(0))
    size = cores_per_run or len(cores) // max(1, parallel)
    if parallel < 1 or size < 1 or parallel * size > len(cores):
        raise ConfigError(
            f"--parallel {parallel} --cores-per-run {size}: this process may use {len(cores)} CPUs"
        )
    return [cores[i * size : (i + 1) * size] for i in range(parallel)]


if __name__ == "__main__":
    main()
