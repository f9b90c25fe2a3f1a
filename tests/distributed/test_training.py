"""Two processes that torchrun starts train one policy, as one process with all their rows would."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from isaacgymenvs_lite.checkpoints.archive import read_archive
from tests.distributed.job import AGENTS, WITH_FIRST_STEP
from tests.learning.test_resuming import assert_same
from tests.tiny import CONFIG, NOT_MEASURED

pytestmark = pytest.mark.slow

REPOSITORY = Path(__file__).parents[2]
NAMES = [*AGENTS, "hrl"]


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


def test_all_processes_hold_the_same_bits(trained):
    for name in NAMES:
        main, other = (content["learned"] for content in trained[name])
        assert_same(main, other)
        assert main["epoch"] == 3
        assert main["modules"]["model"].keys()
        # three epochs of 16 environments, in two processes
        steps = {"hrl": 4 * 5, "lstm": 24}.get(name, 4)
        assert main["frame"] == 3 * 16 * 2 * steps


def test_episodes_of_all_processes_count(trained):
    for name in ["ppo", "amp", "gen_amp", "hrl"]:
        # Each of 32 environments ends two episodes of five steps in 12 steps, HRL's more.
        assert trained[name][0]["learned"]["episodes"] >= 64


def test_processes_have_rows_of_their_own(trained):
    for name in WITH_FIRST_STEP:
        main, other = (content["first"] for content in trained[name])
        assert not torch.equal(main["minibatch"]["obs"], other["minibatch"]["obs"])
        own = [
            torch.cat([g.flatten() for g in each["own_gradients"] if g is not None])
            for each in (main, other)
        ]
        assert float((own[0] - own[1]).norm() / own[0].norm()) > 1e-3


def test_the_gradient_is_that_of_the_joined_rows(trained):
    for name in WITH_FIRST_STEP:
        found, expected = (trained[name][0][key]["gradients"] for key in ("first", "joined"))
        assert [g is None for g in found] == [g is None for g in expected]
        flat = [
            torch.cat([g.flatten() for g in each if g is not None]) for each in (found, expected)
        ]
        # float32, sums in another order
        assert float((flat[0] - flat[1]).norm()) < 1e-5 * float(flat[1].norm())


def test_normalizers_count_the_joined_rows(trained):
    for name in WITH_FIRST_STEP:
        found, expected = (trained[name][0][key]["counted"] for key in ("first", "joined"))
        kinds = {kind for kind, state in found.items() if "running_mean" in state}
        assert kinds >= {"running_mean_std"} | ({"amp_input_mean_std"} if "amp" in name else set())
        for kind in kinds:
            for key, value in expected[kind].items():
                torch.testing.assert_close(found[kind][key], value, rtol=1e-6, atol=1e-7)


# --- mistakes and losses ------------------------------------------------------------------------

TRAIN = str(REPOSITORY / "train.py")
ANT = ("task=Ant", "num_envs=8", "train.params.config.horizon_length=4", "max_iterations=1")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((*ANT, "multi_gpu=True", "checkpoint=no.pth"), "checkpoint=no.pth: no file"),
        ((*ANT, "multi_gpu=True", "numm_envs=3"), "unknown key 'numm_envs'"),
        (ANT, "torchrun has started 2 processes, but multi_gpu is False"),
    ],
)
def test_a_mistake_is_one_line_of_one_process(words, message, tmp_path):
    done = torchrun(TRAIN, *words, folder=tmp_path)
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert done.returncode != 0
    assert len(errors) == 1
    assert message in errors[0]
    assert not (tmp_path / "runs").exists()


PROGRAM = """
import os, sys, time
import isaacgymenvs_lite.learning.ppo as ppo
import isaacgymenvs_lite.learning.resuming as resuming
from isaacgymenvs_lite import train
from isaacgymenvs_lite.tasks.ant import Ant

if os.environ["RANK"] == "1":
    if "settings" in sys.argv[1]:
        sys.argv.append("train.params.config.gamma=0.5")
        # The message is late, as on a machine with other work; the other process must wait for it.
        write = sys.stderr.write
        sys.stderr.write = lambda text: (time.sleep(5 * ("error" in text)), write(text))[1]
    elif "writes" in sys.argv[1]:
        resuming.write_training_state = lambda *state: os._exit(0)
    elif "leaves" in sys.argv[1]:
        ppo.PPOAgent.prepare_dataset = lambda agent, batch: os._exit(0)
    elif "ends" in sys.argv[1]:
        Ant.episode_length = lambda task: 3
del sys.argv[1]
train.main()
"""


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("settings", "rank 1 has another setting than rank 0: train.params.config.gamma='0.5'"),
        ("leaves", "rank 0: another process of this training ended; read its error"),
    ],
)
def test_a_process_that_differs_or_leaves_ends_all(what, message, tmp_path):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    done = torchrun(str(program), what, *ANT, "multi_gpu=True", folder=tmp_path)
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert done.returncode != 0
    assert len(errors) == 1
    assert message in errors[0]
    assert not list(tmp_path.glob("runs/*"))


@pytest.mark.parametrize("rank", [0, 1])
def test_a_process_that_never_joins_is_one_line(rank, tmp_path):
    """It was killed while it started."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    process = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": 2, "LOCAL_WORLD_SIZE": 2}
    address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    variables = {name: str(value) for name, value in {**process, **address}.items()}
    done = subprocess.run(
        [sys.executable, TRAIN, *ANT, "multi_gpu=True", "rl_device=cpu", "distributed_timeout_s=2"],
        cwd=tmp_path,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 2
    (error,) = (line for line in done.stderr.splitlines() if line.startswith("error: "))
    assert f"rank {rank}: another process of this training did not answer in time" in error
    assert "Traceback" not in done.stderr


def test_a_process_that_is_lost_while_it_writes_leaves_no_state_that_cannot_be_read(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    done = torchrun(str(program), "writes", *ANT, "multi_gpu=True", folder=tmp_path)
    assert done.returncode != 0
    assert [file.name for file in tmp_path.glob("runs/*/nn/*")]
    assert not list(tmp_path.glob("runs/*/resume/*"))


def test_episodes_that_end_in_one_process_only_count(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    done = torchrun(str(program), "ends", *ANT, "multi_gpu=True", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "episode length 2, reward" in done.stderr


def test_several_processes_go_on_exactly_and_others_do_too(tmp_path):
    """Four epochs at once, and two and two; and three of one process after two."""
    words = (*ANT, NOT_MEASURED, "multi_gpu=True", "task.env.episodeLength=5")
    words += (f"{CONFIG}.mixed_precision=False",)
    folders = [tmp_path / name for name in ("whole", "stopped", "alone")]
    for folder, epochs in zip(folders, (4, 2), strict=False):
        folder.mkdir()
        done = torchrun(TRAIN, *words, f"max_iterations={epochs}", folder=folder)
        assert done.returncode == 0, done.stderr[-2000:]
    shutil.copytree(folders[1], folders[2])
    again = ("resume=last", "multi_gpu=True", "max_iterations=4")
    assert torchrun(TRAIN, *again, folder=folders[1]).returncode == 0
    for name in ("4.pth", "4_rank1.pth"):
        states = [
            read_archive(next(folder.glob(f"runs/*/resume/{name}"))) for folder in folders[:2]
        ]
        for state in states:
            del state["training_state"]["token"]
        assert_same(*states)
    done = subprocess.run(
        [sys.executable, TRAIN, "resume=last", "max_iterations=3"],
        cwd=folders[2],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0
    assert "2 process(es) wrote the state, 1 resume" in done.stderr
    assert [file.name for file in folders[2].glob("runs/*/resume/*")] == ["3.pth"]
