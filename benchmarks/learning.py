"""Trains experiments for a fixed time and records the results.

    python -m benchmarks.learning EXPERIMENT [EXPERIMENT ...] [key=value ...]
        [--seeds 1 2 3] [--minutes 150] [--motion-file PATH] [--parallel 1] [--resume]
    python -m benchmarks.learning clips [key=value ...] [--clips deepmimic shipped PATH ...]
        [--until-learned] ...

Each seed is one `train.py` process with its own run folder, `<experiment>_seed<n>`. With
`--parallel 2` two processes run at the same time, each on half of the CPUs. Compare parallel runs
by frames, not by minutes. A run saves a checkpoint and ends when its minutes are over or at Ctrl-C.
`--resume` continues a run, and the minutes of all its parts are added. After a run its policy is
played and the result is added to benchmarks/results/<experiment>.jsonl. `benchmarks.evaluate` plays
policies that imitate clips, and `benchmarks.returns` plays policies of classic tasks.

`clips` stands for one experiment for each clip. Its default seed is 1, and it has separate folders.
`benchmarks.clips` prints the table of its results. See also docs/protocol.md.
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
from benchmarks.evaluate import keep, measure, print_medians
from benchmarks.experiments import find_experiment, needs_motion_file
from benchmarks.learned import has_learned, is_learned
from benchmarks.played import RESULTS_DIR
from benchmarks.records import Record
from benchmarks.returns import measure_and_keep
from benchmarks.runs import DEFAULT_RUNS_DIR, Run
from benchmarks.training import Plan, log_file, plan, train_all
from isaacgymenvs_lite.errors import ConfigError, UserError
from isaacgymenvs_lite.run.stop_request import StopRequest


def main() -> None:
    """Train and evaluate all runs."""
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
            keep(records[-1], args.results_dir)

        with StopRequest() as stop:
            todo = [job for job in plans if job.minutes > 0]
            failed = train_all(todo, slots, lambda: stop.requested, on_end=play)
        for run in failed:
            print(f"{run.label} failed; the last lines of {log_file(run)} are:")
            print("\n".join(log_file(run).read_text(encoding="utf-8").splitlines()[-5:]))
        if stop.requested:
            sys.exit("stopped; --resume continues the runs")
        for job in plans:
            if job.minutes == 0:  # trained earlier
                play(job.run)
        print_medians(records)
    except UserError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:  # second Ctrl-C
        sys.exit("stopped at once; --resume continues the runs")
    if failed:
        sys.exit(1)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", nargs="+", help="experiments, and overrides for train.py")
    parser.add_argument("--seeds", type=int, nargs="+", help="default: 1 2 3, for clips: 1")
    parser.add_argument("--minutes", type=float, default=150.0, help="time limit of each run")
    parser.add_argument("--clips", nargs="+", help="clips of the experiment clips")
    parser.add_argument(
        "--until-learned", action="store_true", help="end a clip's training when it is learned"
    )
    parser.add_argument("--motion-file", help="clip of experiments that name no clip")
    parser.add_argument("--parallel", type=int, default=1, help="number of simultaneous runs")
    parser.add_argument("--cores-per-run", type=int, help="default: all, shared by --parallel")
    parser.add_argument("--resume", action="store_true", help="continue existing runs")
    parser.add_argument("--runs-dir", type=Path, default=DEFAULT_RUNS_DIR)
    parser.add_argument("--results-dir", type=Path, default=RESULTS_DIR)
    parser.add_argument("--no-evaluation", action="store_true", help="train only")
    return parser


def _plans(args: argparse.Namespace) -> list[Plan]:
    """Return the plans of all runs, ordered by seed; raise ConfigError for unusable arguments."""
    clips = [word for word in args.clips or () if "=" not in word]
    names = [word for word in args.what if "=" not in word]
    extra = [word for word in (*args.what, *(args.clips or ())) if "=" in word]
    if not names:
        raise ConfigError("give an experiment; benchmarks/experiments.yaml lists all experiments")
    if args.motion_file and not any(needs_motion_file(name) for name in names):
        raise ConfigError(f"--motion-file has no effect for {', '.join(names)}; leave it out")
    for word, given in (("--clips", bool(clips)), ("--until-learned", args.until_learned)):
        if given and CLIPS not in names:
            raise ConfigError(
                f"{word} has no effect for {', '.join(names)}; give the experiment {CLIPS}"
            )
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
    """Return one run for each clip that still lacks training or a record.

    A run has 0 minutes if only the record is missing.

    Raises:
        ConfigError: there are other experiments, or a clip or a run cannot be used.
    """
    if len(names) > 1:
        raise ConfigError(f"{CLIPS} has separate folders; give it alone, not {', '.join(names)}")
    experiments = clip_experiments(clips, extra)
    found = newest_records([each.name for each in experiments], args.results_dir)
    done = {(r.experiment, r.seed): r for records in found.values() for r in records}
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
    """Return disjoint sets of CPUs for `parallel` simultaneous runs.

    Raises:
        ConfigError: this process may use too few CPUs.
    """
    cores = sorted(os.sched_getaffinity(0))
    size = cores_per_run or len(cores) // max(1, parallel)
    if parallel < 1 or size < 1 or parallel * size > len(cores):
        raise ConfigError(
            f"--parallel {parallel} --cores-per-run {size}: this process may use {len(cores)} CPUs;"
            " give smaller values of at least 1"
        )
    return [cores[i * size : (i + 1) * size] for i in range(parallel)]


if __name__ == "__main__":
    main()
