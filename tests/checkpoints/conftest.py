"""A tiny training, and a folder that stands for the shipped policies."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from isaacgymenvs_lite import paths
from tests.tiny import CONFIG, TINY_AMP, train_in

_TINY = (
    "task=HumanoidAMP",
    "task.env.episodeLength=20",
    "task.env.localRootObs=True",  # not the default: a policy must find it as it was
    *TINY_AMP,
    f"{CONFIG}.learning_rate=1e-3",
)


@pytest.fixture(scope="session")
def full_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkpoint of two epochs on the shipped walk, in its run folder."""
    return train_in(tmp_path_factory.mktemp("project"), _TINY) / "nn" / "HumanoidAMP.pth"


@pytest.fixture
def shipped_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder in place of assets/policies."""
    monkeypatch.setattr(paths, "shipped_policies_dir", lambda: tmp_path / "assets" / "policies")
    folder = paths.shipped_policies_dir()
    folder.mkdir(parents=True)
    return folder


@pytest.fixture
def edited_run(full_checkpoint: Path, tmp_path: Path) -> Callable[..., Path]:
    """Return edit(old, new, ...), a checkpoint beside a config.yaml with these texts replaced."""

    def edit(*texts: str) -> Path:
        config = (full_checkpoint.parents[1] / "config.yaml").read_text()
        for old, new in zip(texts[::2], texts[1::2], strict=True):
            assert old in config
            config = config.replace(old, new)
        copy = tmp_path / "run" / "nn" / "copy.pth"
        copy.parent.mkdir(parents=True)
        copy.write_bytes(full_checkpoint.read_bytes())
        (tmp_path / "run" / "config.yaml").write_text(config)
        return copy

    return edit
