"""Broken configuration files and checkpoints: the kinds of benchmarks.fuzz, in a short form."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.fuzz import checkpoints, trees
from benchmarks.fuzz.examine import Examiner, Limits, Verdict
from benchmarks.fuzz.kinds import Kind

SEED = 7
# The long ones take seconds; the benchmark itself reads them.
LONGEST = 2**15
LIMITS = Limits(memory_bytes=2**29)
# What makes a task for every file takes half a second for each; the benchmark reads thousands.
MUTATIONS = {"train_files_alone": 40, "run_folders": 30, "ppo_checkpoints": 60}
KINDS = [kind for kind in (*trees.KINDS, *checkpoints.KINDS) if kind.name in MUTATIONS]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_every_broken_file_is_accepted_or_refused_in_one_line(kind: Kind, tmp_path: Path) -> None:
    examiner = Examiner(kind, tmp_path / kind.name, SEED, LIMITS)
    numbers = range(examiner.num_hostile + MUTATIONS[kind.name])
    outcomes = [examiner.load(n) for n in numbers if len(examiner.content(n)) <= LONGEST]
    assert not [(examiner.name(o.number), o) for o in outcomes if o.is_defect]
    assert {outcome.verdict for outcome in outcomes} == {Verdict.ACCEPTED, Verdict.REFUSED}
