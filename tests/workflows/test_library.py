from __future__ import annotations

import os
import pickle
from pathlib import Path

import pytest
import torch

from isaacgymenvs_lite.errors import CheckpointError
from isaacgymenvs_lite.workflows.library import load_into, read_parameters
from isaacgymenvs_lite.workflows.rsl_rl import LIBRARY as RSL_RL
from isaacgymenvs_lite.workflows.sb3 import LIBRARY as SB3
from isaacgymenvs_lite.workflows.skrl import LIBRARY as SKRL

CONTENTS = {
    "rsl_rl": {"actor_state_dict": {}, "critic_state_dict": {}, "iter": 3},
    "skrl": {"policy": {}, "value": {}, "optimizer": {}},
    "rl_games": {"model": {}, "epoch": 3},
}


@pytest.mark.parametrize("kind", sorted(CONTENTS))
@pytest.mark.parametrize("library", [SB3, SKRL, RSL_RL], ids=lambda library: library.name)
def test_a_checkpoint_of_another_library_is_named(library, kind: str, tmp_path: Path):
    file = tmp_path / "model.pt"
    torch.save(CONTENTS[kind], file)
    if kind == library.name:
        assert read_parameters(file, library) == CONTENTS[kind]
        return
    with pytest.raises(CheckpointError) as caught:
        read_parameters(file, library)
    assert f"a checkpoint of {kind}, expected one of {library.title}; play it with" in str(
        caught.value
    )


class Harmful:
    def __reduce__(self) -> tuple:
        return os.mkdir, (os.environ["HARM"],)


@pytest.mark.parametrize("library", [SB3, SKRL, RSL_RL], ids=lambda library: library.name)
def test_a_file_cannot_run_code(library, tmp_path: Path, monkeypatch):
    monkeypatch.setenv("HARM", str(tmp_path / "harm"))
    saved, pickled = tmp_path / "saved.pt", tmp_path / "pickled.pt"
    torch.save({"policy": Harmful(), "value": {}, "optimizer": {}}, saved)
    pickled.write_bytes(pickle.dumps(Harmful()))
    for file in (saved, pickled):
        with pytest.raises(CheckpointError, match="nothing was run"):
            read_parameters(file, library)
    assert not (tmp_path / "harm").exists()


def test_files_that_are_none(tmp_path: Path):
    with pytest.raises(CheckpointError, match="no such file"):
        read_parameters(tmp_path / "none.pt", SKRL)
    damaged = tmp_path / "damaged.pt"
    damaged.write_bytes(b"no checkpoint")
    with pytest.raises(CheckpointError, match="damaged"):
        read_parameters(damaged, SKRL)
    other = tmp_path / "other.pt"
    torch.save({"weights": torch.zeros(1)}, other)
    with pytest.raises(CheckpointError, match="no checkpoint of a known library"):
        read_parameters(other, SKRL)


def test_parameters_of_another_network_are_an_error(tmp_path: Path):
    layer, other = torch.nn.Linear(2, 3), torch.nn.Linear(2, 4)
    with pytest.raises(CheckpointError, match="of another network or task"):
        load_into(lambda: layer.load_state_dict(other.state_dict()), tmp_path / "a.pt")
