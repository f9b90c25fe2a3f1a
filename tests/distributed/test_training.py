"""Two processes that torchrun starts train one policy, as one process with all their rows would."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.distributed.job import AGENTS

REPOSITORY = Path(__file__).parents[2]
NAMES = [*AGENTS, "hrl"]
WITH_OWN_LOSS = ["amp", "gen_amp", "hrl"]


def torchrun(*words: str, folder: Path, num_processes: int = 2) -> subprocess.CompletedProcess[str]:
    """Start processes in a folder; their package is this one."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += [f"--nproc-per-node={num_processes}", *words]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> dict[str, list[Any]]:
    """Return what each of two processes has learned, and the first step, by agent."""
    folder = tmp_path_factory.mktemp("ranks")
    done = torchrun("-m", "tests.distributed.job", str(folder), folder=folder)
    assert done.returncode == 0, done.stderr[-3000:]
    return {
        name: [torch.load(folder / f"{name}_{rank}.pth", weights_only=True) for rank in (0, 1)]
        for name in NAMES
    }


def assert_same(one: Any, other: Any, where: str = "") -> None:
    if isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key in one:
            assert_same(one[key], other[key], f"{where}.{key}")
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other), where
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_same(a, b, f"{where}.{i}")
    elif isinstance(one, Tensor):
        assert torch.equal(one, other), where
    else:
        assert one == other, where


@pytest.mark.parametrize("name", NAMES)
def test_all_processes_hold_the_same_bits(name, trained):
    main, other = (content["learned"] for content in trained[name])
    assert_same(main, other)
    assert main["epoch"] == 3
    assert main["modules"]["model"].keys()
    # three epochs of 4 steps of 16 environments, in two processes
    steps = 5 if name == "hrl" else 1
    assert main["frame"] == 3 * 4 * 16 * 2 * steps


@pytest.mark.parametrize("name", ["ppo", "amp", "gen_amp", "hrl"])
def test_episodes_of_all_processes_count(name, trained):
    # Each of 32 environments ends two episodes of five steps in 12 steps, HRL's more.
    assert trained[name][0]["learned"]["episodes"] >= 64


@pytest.mark.parametrize("name", WITH_OWN_LOSS)
def test_processes_have_rows_of_their_own(name, trained):
    main, other = (content["first"] for content in trained[name])
    assert not torch.equal(main["minibatch"]["obs"], other["minibatch"]["obs"])
    own = [
        torch.cat([g.flatten() for g in each["own_gradients"] if g is not None])
        for each in (main, other)
    ]
    assert float((own[0] - own[1]).norm() / own[0].norm()) > 1e-3


@pytest.mark.parametrize("name", WITH_OWN_LOSS)
def test_the_gradient_is_that_of_the_joined_rows(name, trained):
    found, expected = (trained[name][0][key]["gradients"] for key in ("first", "joined"))
    assert [g is None for g in found] == [g is None for g in expected]
    flat = [torch.cat([g.flatten() for g in each if g is not None]) for each in (found, expected)]
    # float32, sums in another order
    assert float((flat[0] - flat[1]).norm()) < 1e-5 * float(flat[1].norm())


@pytest.mark.parametrize("name", WITH_OWN_LOSS)
def test_normalizers_count_the_joined_rows(name, trained):
    found, expected = (trained[name][0][key]["counted"] for key in ("first", "joined"))
    kinds = {kind for kind, state in found.items() if "running_mean" in state}
    assert kinds >= {"running_mean_std"} | ({"amp_input_mean_std"} if name != "hrl" else set())
    for kind in kinds:
        for key, value in expected[kind].items():
            torch.testing.assert_close(found[kind][key], value, rtol=1e-6, atol=1e-7)
