from __future__ import annotations

from pathlib import Path

from isaacgymenvs_lite.checkpoints.files import Retention


def write(folder: Path, name: str) -> Path:
    file = folder / name
    file.write_text("checkpoint")
    return file


def test_the_newest_epochs_stay(tmp_path):
    for keep in [0, 1, 3]:
        retention = Retention(keep)
        for epoch in (5, 10, 15, 20):
            for name in ("a", "b"):  # rl_games may write an epoch twice
                retention.written(write(tmp_path, f"{name}{epoch}"), epoch)
        kept = {int(file.name[1:]) for file in tmp_path.iterdir()}
        assert kept == set((5, 10, 15, 20)[-keep:])
        assert len(list(tmp_path.iterdir())) == 2 * len(kept)


def test_other_files_stay(tmp_path):
    retention = Retention(1)
    best = write(tmp_path, "best")
    for epoch in (1, 2):
        retention.written(write(tmp_path, str(epoch)), epoch)
    assert {file.name for file in tmp_path.iterdir()} == {best.name, "2"}
