"""Measures the returns of a classic task's policy."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.returns import main
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.runner import run


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the run folder of a short training of Cartpole."""
    folder = tmp_path_factory.mktemp("runs")
    run(
        compose(
            [
                *("task=Cartpole", "num_envs=64", "max_iterations=2", "seed=1"),
                *("rl_device=cpu", "num_threads=1", f"+train.params.config.train_dir={folder}"),
                "+full_experiment_name=cartpole_seed1",
            ]
        )
    )
    return folder / "cartpole_seed1"


def test_it_plays_whole_episodes_and_writes_a_line(cartpole: Path, tmp_path: Path, capsys) -> None:
    main([str(cartpole), "--write", "--results-dir", str(tmp_path)])
    said = capsys.readouterr().out
    row = json.loads((tmp_path / "cartpole.jsonl").read_text())
    assert f"return {row['episode_return']:.2f}" in said
    assert (row["num_episodes"], row["max_steps"], row["seed"]) == (128, 499, 1)
    assert 1 < row["steps"] <= 499
    # The reward is at most 1 a step and -2 in the step in which a pole falls.
    assert -2.0 < row["episode_return"] <= row["steps"]
    assert row["frames"] == 2 * 64 * 16


def test_the_same_starts_give_the_same_numbers(cartpole: Path, capsys) -> None:
    main([str(cartpole)])
    first = capsys.readouterr().out
    main([str(cartpole)])
    assert capsys.readouterr().out == first
    main([str(cartpole), "--evaluation-seed", "5"])
    assert capsys.readouterr().out != first
