from __future__ import annotations

import errno
import os
import pickle
import signal
import subprocess
import sys
import textwrap
import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from isaacgymenvs_lite import checkpoints
from isaacgymenvs_lite.errors import CheckpointError


def state(seed: int = 0) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(seed)
    return {
        "model": OrderedDict(weight=torch.rand(3, 2, generator=generator)),
        "epoch": seed,
        "optimizer": {"state": {0: {"step": torch.tensor(1.0)}}, "param_groups": [{"lr": 0.1}]},
        "last_mean_rewards": -1.0,
        "env_state": None,
    }


def refusal(path: Path | str) -> str:
    """The message that refuses a file: one line which names it."""
    with pytest.raises(CheckpointError) as caught:
        checkpoints.load_checkpoint(path)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


@pytest.fixture
def rescue_dir(tmp_path, monkeypatch) -> Path:
    """Where rescued checkpoints go instead of the system's temporary folder."""
    folder = tmp_path / "system_tmp"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


# --- writing ----------------------------------------------------------------------------------


def test_a_checkpoint_comes_back(tmp_path):
    checkpoints.save_checkpoint(str(tmp_path / "model"), state(3))
    assert [path.name for path in tmp_path.iterdir()] == ["model.pth"]
    loaded = checkpoints.load_checkpoint(tmp_path / "model.pth")
    assert torch.equal(loaded["model"]["weight"], state(3)["model"]["weight"])
    assert loaded["epoch"] == 3
    assert loaded["env_state"] is None
    assert loaded["optimizer"]["state"][0]["step"] == 1.0


def test_a_name_with_dots_keeps_them(tmp_path):
    # rl_games' own names: last_<name>_ep_2_rew_12.5
    checkpoints.save_checkpoint(str(tmp_path / "last_Humanoid_ep_2_rew__12.5_"), state())
    assert [path.name for path in tmp_path.iterdir()] == ["last_Humanoid_ep_2_rew__12.5_.pth"]


class FailsHalfway:
    """Stands in for torch.save: writes half of the file, then fails."""

    def __init__(self, error: BaseException) -> None:
        self.error = error

    def __call__(self, obj: Any, file: Any) -> None:
        file.write(b"PK half a checkpoint")
        file.flush()
        raise self.error


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        # what torch's zip writer makes of a failed write
        RuntimeError("[enforce fail at inline_container.cc:603] . unexpected pos 64 vs 0"),
    ],
    ids=["OSError", "RuntimeError"],
)
def test_a_failure_in_the_middle_leaves_the_old_file(error, tmp_path, monkeypatch):
    path = tmp_path / "model.pth"
    checkpoints.write_atomically(path, state(1))
    old = path.read_bytes()
    monkeypatch.setattr(torch, "save", FailsHalfway(error))
    with pytest.raises(OSError):
        checkpoints.write_atomically(path, state(2))
    assert path.read_bytes() == old
    assert [file.name for file in tmp_path.iterdir()] == ["model.pth"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), MemoryError(), pickle.PicklingError("no")])
def test_any_other_end_leaves_no_debris_either(error, tmp_path, monkeypatch):
    path = tmp_path / "model.pth"
    checkpoints.write_atomically(path, state(1))
    old = path.read_bytes()
    monkeypatch.setattr(torch, "save", FailsHalfway(error))
    with pytest.raises(type(error)):
        checkpoints.write_atomically(path, state(2))
    assert path.read_bytes() == old
    assert [file.name for file in tmp_path.iterdir()] == ["model.pth"]


def test_a_full_disk_is_an_oserror(tmp_path, monkeypatch):
    """/dev/full takes nothing: the failure comes from torch's own writer or from the flush."""
    opened = Path.open

    def open_full(self: Path, *args: Any, **kwargs: Any) -> Any:
        if self.name.endswith(".partial"):
            return opened(Path("/dev/full"), *args, **kwargs)
        return opened(self, *args, **kwargs)

    monkeypatch.setattr(Path, "open", open_full)
    with pytest.raises(OSError):
        checkpoints.write_atomically(tmp_path / "model.pth", state())
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_loses_nothing(tmp_path, rescue_dir, caplog):
    (tmp_path / "run_7").write_text("a file where the run folder should be")
    checkpoints.save_checkpoint(str(tmp_path / "run_7" / "nn" / "model"), state(5))
    (rescued,) = rescue_dir.rglob("*.pth")
    assert "run_7" in str(rescued)
    assert checkpoints.load_checkpoint(rescued)["epoch"] == 5
    (record,) = caplog.records
    assert record.levelname == "ERROR"
    for words in ("run_7", str(rescued), "training goes on"):
        assert words in record.getMessage()


def test_a_full_disk_is_rescued_elsewhere(tmp_path, rescue_dir, monkeypatch, caplog):
    run = tmp_path / "runs" / "walk" / "nn"
    run.mkdir(parents=True)
    real_save = torch.save

    def save(obj: Any, file: Any) -> None:
        if str(rescue_dir) not in str(file.name):
            raise OSError(errno.ENOSPC, "No space left on device")
        real_save(obj, file)

    monkeypatch.setattr(torch, "save", save)
    checkpoints.save_checkpoint(str(run / "model"), state(6))
    (rescued,) = rescue_dir.rglob("*.pth")
    assert checkpoints.load_checkpoint(rescued)["epoch"] == 6
    assert "No space left" in caplog.text
    assert list(run.iterdir()) == []


def test_training_goes_on_when_nothing_can_be_written(tmp_path, rescue_dir, monkeypatch, caplog):
    monkeypatch.setattr(torch, "save", FailsHalfway(OSError(errno.ENOSPC, "No space left")))
    checkpoints.save_checkpoint(str(tmp_path / "model"), state())
    (record,) = caplog.records
    assert record.levelname == "ERROR"
    assert "No space left" in record.getMessage()
    assert not list(tmp_path.rglob("*.pth"))


_KILLED = """
import sys, torch
from pathlib import Path
from isaacgymenvs_lite import checkpoints

path = Path(sys.argv[1])
big = {"model": {"weight": torch.zeros(4_000_000)}, "epoch": 0}
checkpoints.write_atomically(path, big)
print("ready", flush=True)
while True:
    big["epoch"] += 1
    checkpoints.write_atomically(path, big)
"""


@pytest.mark.parametrize("delay_s", [0.05, 0.11, 0.23])
def test_a_kill_at_any_moment_leaves_a_whole_checkpoint(delay_s, tmp_path):
    path = tmp_path / "model.pth"
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(_KILLED), str(path)], stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    time.sleep(delay_s)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert checkpoints.load_checkpoint(path)["model"]["weight"].shape == (4_000_000,)


def test_numpy_scalars_become_numbers(tmp_path):
    given = {
        "model": {"weight": torch.ones(2)},
        "last_mean_rewards": np.float32(1.5),
        "epoch": np.int64(7),
        "best": np.bool_(True),
        "env_state": {"curriculum": [np.float64(0.25), (np.int32(3),)], "bins": np.arange(3.0)},
    }
    checkpoints.save_checkpoint(str(tmp_path / "model"), given)
    # nothing but torch's own safe loader is needed
    loaded = torch.load(tmp_path / "model.pth", weights_only=True)
    assert (loaded["last_mean_rewards"], loaded["epoch"], loaded["best"]) == (1.5, 7, True)
    assert loaded["env_state"]["curriculum"] == [0.25, (3,)]
    assert loaded["env_state"]["bins"].tolist() == [0.0, 1.0, 2.0]
    # and what was given is as it was
    assert type(given["last_mean_rewards"]) is np.float32


# --- reading ----------------------------------------------------------------------------------


def test_what_plain_rl_games_writes_loads(tmp_path):
    """It stores its best reward as a numpy scalar, which torch's safe loader refuses."""
    for number in (np.float32(3.5), np.float64(3.5)):
        torch.save({**state(), "last_mean_rewards": number}, tmp_path / "plain.pth")
        assert checkpoints.load_checkpoint(tmp_path / "plain.pth")["last_mean_rewards"] == 3.5


def test_the_prefix_of_compiled_models_is_stripped(tmp_path):
    model = {"_orig_mod.a2c_network.mu.weight": torch.ones(1), "value.bias": torch.zeros(1)}
    torch.save({"model": model}, tmp_path / "compiled.pth")
    loaded = checkpoints.load_checkpoint(tmp_path / "compiled.pth")
    assert set(loaded["model"]) == {"a2c_network.mu.weight", "value.bias"}


def statistics(value: float) -> dict[str, torch.Tensor]:
    return {
        "running_mean": torch.tensor([value]),
        "running_var": torch.tensor([value + 1]),
        "count": torch.tensor(value + 2),
    }


def test_normalisers_beside_the_model_are_moved_into_it(tmp_path):
    """Files of rl_games 1.1.4, which ASE used."""
    old = {
        "model": {"a2c_network.sigma": torch.zeros(2)},
        "running_mean_std": statistics(1.0),
        "reward_mean_std": statistics(10.0),
        "amp_input_mean_std": statistics(100.0),
    }
    torch.save(old, tmp_path / "ase.pth")
    loaded = checkpoints.load_checkpoint(tmp_path / "ase.pth")
    assert {name: float(value.sum()) for name, value in loaded["model"].items()} == {
        "a2c_network.sigma": 0.0,
        "running_mean_std.running_mean": 1.0,
        "running_mean_std.running_var": 2.0,
        "running_mean_std.count": 3.0,
        "value_mean_std.running_mean": 10.0,
        "value_mean_std.running_var": 11.0,
        "value_mean_std.count": 12.0,
    }
    assert loaded["amp_input_mean_std"]["count"] == 102.0


def test_normalisers_in_the_model_win(tmp_path):
    model = {"running_mean_std.count": torch.tensor(5.0)}
    torch.save({"model": model, "running_mean_std": statistics(1.0)}, tmp_path / "both.pth")
    loaded = checkpoints.load_checkpoint(tmp_path / "both.pth")
    assert loaded["model"]["running_mean_std.count"] == 5.0


def test_checkpoints_of_sac_load(tmp_path):
    """rl_games' own SAC keeps its networks under keys of its own; it loads through here too."""
    sac = {"actor": {"w": torch.ones(1)}, "critic": {}, "critic_target": {}, "epoch": 1}
    torch.save(sac, tmp_path / "sac.pth")
    assert checkpoints.load_checkpoint(tmp_path / "sac.pth")["actor"]["w"] == 1.0


class Malicious:
    """Runs `function(*arguments)` when a full unpickler reads it."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.function, self.arguments


@pytest.mark.parametrize(
    ("function", "name"),
    [(os.system, "posix.system"), (eval, "eval"), (subprocess.Popen, "Popen")],
    ids=["os.system", "eval", "Popen"],
)
@pytest.mark.parametrize("zipped", [True, False], ids=["zip", "legacy"])
def test_a_file_that_would_run_code_is_refused(function, name, zipped, tmp_path):
    path, marker = tmp_path / "evil.pth", tmp_path / "was_here"
    command: Any = f"touch {marker}"
    if function is eval:
        command = f"open({str(marker)!r}, 'w').close()"
    elif function is subprocess.Popen:
        command = ["touch", str(marker)]
    evil = {**state(), "extra": Malicious(function, command)}
    torch.save(evil, path, _use_new_zipfile_serialization=zipped)
    message = refusal(path)
    assert name in message
    assert "refused" in message
    assert not marker.exists()


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_a_bare_pickle_that_would_run_code_is_refused(protocol, tmp_path):
    marker = tmp_path / "was_here"
    evil = {"model": {}, "extra": Malicious(os.system, f"touch {marker}")}
    (tmp_path / "evil.pth").write_bytes(pickle.dumps(evil, protocol))
    refusal(tmp_path / "evil.pth")
    assert not marker.exists()


def test_every_truncated_file_is_refused(tmp_path):
    checkpoints.save_checkpoint(str(tmp_path / "model"), state())
    whole = (tmp_path / "model.pth").read_bytes()
    path = tmp_path / "cut.pth"
    for size in range(0, len(whole), 61):
        path.write_bytes(whole[:size])
        assert "damaged" in refusal(path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"hello world\n",
        b"epoch,reward\n1,0.5\n",
        b"name: HumanoidAMP\n",
        b"version https://git-lfs.github.com/spec/v1\noid sha256:12\n",
        b"<html><body>404</body></html>",
        b"\x00" * 100,
        b"\x89PNG\r\n\x1a\n",
        b"step 1",
    ],
    ids=["empty", "text", "csv", "yaml", "lfs", "html", "zeros", "png", "step"],
)
def test_a_file_of_another_kind_is_refused(content, tmp_path):
    path = tmp_path / "other.pth"
    path.write_bytes(content)
    message = refusal(path)
    assert "expected a .pth file" in message
    # torch's advice to load it without protection is no next step
    assert "weights_only" not in message
    assert "torch.load" not in message


@pytest.mark.parametrize("content", [[1, 2], {"epoch": 1}, {"model": 3}, torch.ones(2)])
def test_a_file_without_a_model_is_refused(content, tmp_path):
    torch.save(content, tmp_path / "other.pth")
    assert "no model" in refusal(tmp_path / "other.pth")


def test_a_missing_file_is_named_at_once(tmp_path):
    assert "no such file" in refusal(tmp_path / "none.pth")
    assert "no such file" in refusal(tmp_path)


def test_rl_games_saves_and_loads_through_this_module():
    from rl_games.algos_torch import torch_ext

    checkpoints.install()
    assert torch_ext.save_checkpoint is checkpoints.save_checkpoint
    assert torch_ext.load_checkpoint is checkpoints.load_checkpoint


# --- finding ----------------------------------------------------------------------------------


@pytest.fixture
def runs(tmp_path) -> Callable[..., Path]:
    """Return make(run, task, {file name: age in s}), which makes a run folder."""

    def make(run: str, task: str | None, ages: dict[str, float]) -> Path:
        folder = tmp_path / "runs" / run
        (folder / "nn").mkdir(parents=True)
        if task is not None:
            (folder / "config.yaml").write_text(f"task:\n  name: {task}\nseed: 1\n")
        now = time.time()
        for name, age in ages.items():
            file = folder / "nn" / name
            file.write_bytes(b"x")
            os.utime(file, (now - age, now - age))
        return folder

    return make


def test_last_is_the_newest_of_the_same_task(runs, tmp_path):
    runs("old", "HumanoidAMP", {"HumanoidAMP.pth": 500.0, "last_HumanoidAMP_ep_9.pth": 400.0})
    new = runs("new", "HumanoidAMP", {"HumanoidAMP.pth": 300.0, "last_HumanoidAMP_ep_5.pth": 200.0})
    runs("other", "Ant", {"Ant.pth": 100.0})
    runs("unknown", None, {"x.pth": 50.0})
    found = checkpoints.resolve_checkpoint("last", tmp_path / "runs", "HumanoidAMP")
    assert found == str(new / "nn" / "last_HumanoidAMP_ep_5.pth")
    assert Path(found).is_absolute()


def test_last_overlooks_what_is_no_checkpoint(runs, tmp_path):
    run = runs("run", "Ant", {"Ant.pth": 300.0, ".Ant.pth.17.partial": 10.0, "notes.txt": 10.0})
    (tmp_path / "runs" / "file").write_text("not a run")
    found = checkpoints.resolve_checkpoint("last", tmp_path / "runs", "Ant")
    assert found == str(run / "nn" / "Ant.pth")


@pytest.mark.parametrize(
    "config",
    ["", "- a\n- list\n", "task: HumanoidAMP\n", "task:\n", "task: {name: [", "a: ${b\n", "\x00"],
    ids=["empty", "list", "text", "null", "cut", "interpolation", "binary"],
)
def test_a_damaged_run_folder_does_not_hide_the_others(config, runs, tmp_path):
    (runs("damaged", None, {"a.pth": 1.0}) / "config.yaml").write_text(config)
    good = runs("good", "Ant", {"Ant.pth": 300.0})
    found = checkpoints.resolve_checkpoint("last", tmp_path / "runs", "Ant")
    assert found == str(good / "nn" / "Ant.pth")


def test_without_any_run_last_says_what_to_do(tmp_path, runs):
    runs("other", "Ant", {"Ant.pth": 1.0})
    for folder in (tmp_path / "runs", tmp_path / "nowhere"):
        with pytest.raises(CheckpointError, match="task=HumanoidAMP") as caught:
            checkpoints.resolve_checkpoint("last", folder, "HumanoidAMP")
        assert str(folder) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_path_is_made_absolute(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.pth").write_bytes(b"x")
    assert checkpoints.resolve_checkpoint("a.pth", "runs", "Ant") == str(tmp_path / "a.pth")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert checkpoints.resolve_checkpoint("~/a.pth", "runs", "Ant") == str(tmp_path / "a.pth")


def test_no_checkpoint_is_no_path(tmp_path):
    assert checkpoints.resolve_checkpoint("", tmp_path, "Ant") == ""


def test_a_wrong_path_is_named_with_a_hint(tmp_path):
    (tmp_path / "a.pth").write_bytes(b"x")
    with pytest.raises(CheckpointError, match=r"did you mean .*a\.pth\?") as caught:
        checkpoints.resolve_checkpoint(str(tmp_path / "a"), "runs", "Ant")
    assert "\n" not in str(caught.value)
    with pytest.raises(CheckpointError, match="no file"):
        checkpoints.resolve_checkpoint(str(tmp_path), "runs", "Ant")
