"""A training whose simulations diverge now and then: counted, written down, shown again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from isaacgymenvs_lite.env_factory import model_of_recording
from isaacgymenvs_lite.report.scalars import read_scalars
from isaacgymenvs_lite.run.divergence import DivergenceFiles
from isaacgymenvs_lite.simulation import replay
from isaacgymenvs_lite.simulation.recording import read_recording
from tests.tiny import TINY_PPO, train_in

# Motors that now and then make a joint faster than anything physical.
STRONG = "task.env.powerScale=100"


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("diverging")
    return train_in(folder, ["task=Ant", *TINY_PPO, "num_envs=32", "seed=4", STRONG])


def test_they_are_counted_in_each_epoch(run_folder: Path) -> None:
    scalars = read_scalars(run_folder / "summaries")
    counts = scalars["sim/diverged"].values
    assert len(counts) == 2
    assert all(0 < count < 32 * 4 for count in counts)


def test_the_first_ones_are_written_and_can_be_shown(run_folder: Path, capsys: Any) -> None:
    files = sorted((run_folder / "diverged").iterdir())
    assert 0 < len(files) <= 20
    assert files[0].name == "0001.npz"
    assert sum(file.stat().st_size for file in files) < 200_000
    assert read_recording(files[0]).task == "Ant"
    assert replay.main([str(files[0])], model_of_recording) == 0
    shown = capsys.readouterr().out
    assert "of Ant" in shown
    assert "was made with another model" not in shown
    assert "diverged in control step" in shown


class _Task:
    """A task with the recordings of a run."""

    def __init__(self, recordings: list[Any]) -> None:
        self.simulation, self.cfg = self, {"name": "Ant"}
        self.recordings = recordings


def test_a_folder_that_cannot_be_written_does_not_end_the_training(
    run_folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recording = read_recording(run_folder / "diverged" / "0001.npz")
    (tmp_path / "diverged").write_text("a file in its place")
    files = DivergenceFiles(_Task([recording] * 2), tmp_path)
    files.after_step()
    files.after_step()
    assert len(caplog.messages) == 1
    assert "not recorded any more" in caplog.messages[0]
