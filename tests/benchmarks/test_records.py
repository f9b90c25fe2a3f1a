from __future__ import annotations

import json
from dataclasses import replace

from benchmarks.records import (
    Record,
    markdown_table,
    medians,
    numbers_line,
    read_records,
    spread_cell,
    write_records,
)

RECORD = Record(
    experiment="walk",
    seed=1,
    run="walk_seed1",
    checkpoint="last.pth",
    frames=1_000_000,
    epoch=61,
    minutes=3.0,
    minutes_to_280=2.0,
    frames_to_280=500_000.0,
    minutes_to_learned=1.5,
    frames_to_learned=400_000.0,
    pose_error_m=0.03,
    no_fall_share=1.0,
    tempo=1.0,
    motion_shown=0.97,
    speed_m_s=1.5,
    clip_speed_m_s=1.5,
    mean_episode_steps=299.0,
    num_episodes=32,
    evaluation_seed=1234,
    machine="a machine",
    commit="abc",
    cores=2,
    settings=["task=HumanoidAMP"],
)


def seeds(**values: list) -> list[Record]:
    (name, column), *_ = values.items()
    return [replace(RECORD, seed=i, **{name: value}) for i, value in enumerate(column)]


def test_medians():
    for column, expected in [
        ([0.05, 0.03, 0.04], 0.04),
        ([0.05, 0.03], 0.04),
        ([None, 0.03, 0.04], 0.04),  # None counts as infinite
        ([None, None, 0.04], None),
        ([None, 0.04], None),
        ([None], None),
    ]:
        assert medians(seeds(pose_error_m=column))["pose_error_m"] == expected


def test_cells_of_tables():
    for values, expected in [
        ([1.0, 3.0, 2.0], "2.0 (1.0 to 3.0)"),
        ([1.0, None, 2.0], "2.0 (1.0 to none)"),
        ([None, None, 2.0], "none (2.0 to none)"),
        ([None], "none"),
        ([float("nan"), 1.0, 1.0], "1.0 (1.0 to none)"),
        ([1.01, 1.02], "1.0"),
    ]:
        assert spread_cell(values, ".1f") == expected


def test_table_has_a_row_for_each_experiment():
    other = replace(RECORD, experiment="run", frames=2_000_000, minutes_to_280=None)
    header, rule, walk, run = markdown_table([RECORD, replace(RECORD, seed=2), other]).splitlines()
    assert header.count("|") == rule.count("|") == walk.count("|") == run.count("|")
    assert walk.startswith("| walk | 2 | 1.0 | 3 | 0.030 | 1.00 |")
    assert run.startswith("| run | 1 | 2.0 |")
    assert " none |" in run


def test_records_are_written_and_read(tmp_path):
    lost = replace(RECORD, experiment="run", pose_error_m=None)
    files = write_records([RECORD, lost], tmp_path / "results")
    assert [file.name for file in files] == ["walk.jsonl", "run.jsonl"]
    assert read_records(files[0]) == [RECORD]
    assert read_records(files[1]) == [lost]
    assert json.loads(files[1].read_text())["pose_error_m"] is None


def test_a_record_replaces_the_one_of_the_same_policy_only(tmp_path):
    write_records([replace(RECORD, seed=2, run="walk_seed2"), RECORD], tmp_path)
    later = replace(RECORD, frames=2_000_000)
    better = replace(RECORD, pose_error_m=0.02)
    (file,) = write_records([later, better], tmp_path)
    assert read_records(file) == [better, later, replace(RECORD, seed=2, run="walk_seed2")]


def test_errors_of_goals_are_shown_and_kept(tmp_path):
    errors = [{"turn_error_rad_s": 0.1}, {"turn_error_rad_s": 0.3}, {}]
    records = [replace(r, run=f"walk_seed{r.seed}") for r in seeds(goal_errors=errors)]
    assert medians(records)["goal_errors"] == {"turn_error_rad_s": 0.3}  # None counts as infinite
    assert "turn_error_rad_s 0.300," in numbers_line(medians(records))
    header, _, row = markdown_table(records[:2]).splitlines()
    assert header.endswith("| turn error rad s |")
    assert row.endswith("| 0.200 (0.100 to 0.300) |")
    (file,) = write_records(records, tmp_path)
    assert [record.goal_errors for record in read_records(file)] == errors
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    old = [{key: row[key] for key in row if key != "goal_errors"} for row in lines]
    file.write_text("".join(json.dumps(row) + "\n" for row in old))
    assert [record.goal_errors for record in read_records(file)] == [{}] * 3
