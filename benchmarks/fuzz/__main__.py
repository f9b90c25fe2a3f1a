"""Breaks thousands of files and has them read: each must be accepted or refused in one line.

    python -m benchmarks.fuzz [--inputs 20000] [--kinds npz bvh ...] [--seed 0] [--only NUMBER]
        [--processes 3] [--keep DIR]

The inputs are shared out evenly among the kinds. Valid files are written by the project's own
writers and broken by `mutators`; the first of each kind are hostile ones made by hand. Each is read
by the public loader in a process with limits, every 50th also by the kind's command; `--processes`
of each kind are read by the command in a process of its own.

refused: a UserError of one line and at most 2000 characters that names the file. other: anything
else, a traceback or a warning among them. hangs: over 5 s of the processor. memory: the process
grew by more than 1 GiB. code: the file ran something. The files of the last four are kept, with how
to repeat them, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch

from benchmarks.fuzz.campaign import Plan, Tally, run, run_processes
from benchmarks.fuzz.examine import Examiner, Limits, Verdict
from benchmarks.fuzz.kinds import all_kinds
from benchmarks.machine import describe_machine

_COMMAND_EVERY = 50
_SHOWN_DEFECTS = 5
_SHOWN_CHARACTERS = 1500
_COLUMNS = tuple(Verdict)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    kinds = all_kinds()
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.fuzz",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--kinds", nargs="+", choices=list(kinds), default=list(kinds))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="number of one file of one kind")
    parser.add_argument("--processes", type=int, default=3, help="real processes for each kind")
    parser.add_argument("--keep", type=Path, default=Path("runs/fuzz"), help="for defects")
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)  # no threads before the first fork
    print(describe_machine(), flush=True)
    print(_row("", "inputs", *(verdict.value for verdict in _COLUMNS), "MiB", "s"), flush=True)
    tallies: list[Tally] = []
    with tempfile.TemporaryDirectory() as scratch:
        for name in args.kinds:
            count = 1 if args.only is not None else -(-args.inputs // len(args.kinds))
            plan = Plan(
                kinds[name],
                Path(scratch) / name,
                first=args.only or 0,
                count=count,
                seed=args.seed,
                command_every=1 if args.only is not None else _COMMAND_EVERY,
            )
            tallies.append(_run_and_show(plan, run(plan), args.keep))
            if args.processes and args.only is None and plan.kind.command:
                sample = Plan(plan.kind, plan.folder, 0, min(args.processes, count), args.seed)
                tallies.append(_run_and_show(sample, run_processes(sample), args.keep))
    print(_figures("all", tallies))
    return int(any(tally.defects for tally in tallies))


def _run_and_show(plan: Plan, tally: Tally, keep: Path) -> Tally:
    print(_figures(tally.kind, [tally]), flush=True)
    if tally.defects:
        _keep_defects(plan, tally, keep)
    return tally


def _keep_defects(plan: Plan, tally: Tally, keep: Path) -> None:
    """Write the files of a tally's defects and print the first ones."""
    with tempfile.TemporaryDirectory() as scratch:
        examiner = Examiner(plan.kind, Path(scratch) / plan.kind.name, plan.seed, Limits())
        for index, defect in enumerate(tally.defects):
            folder = keep / plan.kind.name
            folder.mkdir(parents=True, exist_ok=True)
            file = folder / f"{plan.seed}_{defect.number}{plan.kind.suffix}"
            file.write_bytes(examiner.content(defect.number))
            if index < _SHOWN_DEFECTS:
                again = f"--kinds {plan.kind.name} --seed {plan.seed} --only {defect.number}"
                print(
                    f"  {defect.verdict.value}: {file} {examiner.name(defect.number)}\n"
                    f"    again: python -m benchmarks.fuzz {again}\n"
                    f"    {defect.message[-_SHOWN_CHARACTERS:]}",
                    file=sys.stderr,
                    flush=True,
                )


def _figures(name: str, tallies: list[Tally]) -> str:
    """Return the row of the table that belongs to one or more tallies."""
    counts = [sum(tally.counts[verdict] for tally in tallies) for verdict in _COLUMNS]
    memory_mib = max(tally.largest_bytes for tally in tallies) / 2**20
    slowest_s = max(tally.slowest_s for tally in tallies)
    return _row(name, f"{sum(counts)}", *map(str, counts), f"{memory_mib:.0f}", f"{slowest_s:.2f}")


def _row(name: str, *cells: str) -> str:
    return f"{name:24}" + "".join(f"{cell:>10}" for cell in cells)


if __name__ == "__main__":
    sys.exit(main())
