"""Reading checkpoints without running their code, and finding them."""

from __future__ import annotations

import os
import pickle
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.checkpoints import files as checkpoints
from isaacgymenvs_lite.errors import CheckpointError


def state() -> dict[str, Any]:
    return {"model": {"weight": torch.ones(3, 2)}, "epoch": 0, "last_mean_rewards": -1.0}


def refusal(path: Path | str) -> str:
    """The message that refuses a file: one line which names it."""
    with pytest.raises(CheckpointError) as caught:
        checkpoints.load_checkpoint(path)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


# --- reading ----------------------------------------------------------------------------------


def test_what_plain_rl_games_writes_loads(tmp_path):
    """It stores its best reward as a numpy scalar, which torch's safe loader refuses."""
    for number in (np.float32(3.5), np.float64(3.5), torch.tensor(3.5)):
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


def test_a_file_that_would_run_code_is_refused(tmp_path):
    for function, name in [
        (os.system, "posix.system"),
        (eval, "eval"),
        (subprocess.Popen, "Popen"),
    ]:
        for zipped in [True, False]:
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


def test_a_bare_pickle_that_would_run_code_is_refused(tmp_path):
    for protocol in [0, 2, 4]:
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


def test_a_file_of_another_kind_is_refused(tmp_path):
    for content in [
        b"",
        b"hello world\n",
        b"version https://git-lfs.github.com/spec/v1\noid sha256:12\n",
        b"<html><body>404</body></html>",
        b"\x00" * 100,
        b"\x89PNG\r\n\x1a\n",
    ]:
        path = tmp_path / "other.pth"
        path.write_bytes(content)
        message = refusal(path)
        assert "expected a .pth file" in message
        # torch's advice to load it without protection is no next step
        assert "weights_only" not in message
        assert "torch.load" not in message


def test_a_file_without_a_model_is_refused(tmp_path):
    for content in [[1, 2], {"epoch": 1}, {"model": 3}, torch.ones(2)]:
        torch.save(content, tmp_path / "other.pth")
        assert "no model" in refusal(tmp_path / "other.pth")


def test_a_missing_file_is_named_at_once(tmp_path):
    assert "no such file" in refusal(tmp_path / "none.pth")
    assert "no such file" in refusal(tmp_path)


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


def test_last_is_of_the_same_kind_of_network(runs, tmp_path):
    """The levels of a hierarchy are trained on one task."""
    for run, network, age in (("low", "gen_amp", 300.0), ("high", "hrl", 100.0)):
        folder = runs(run, "HumanoidASE", {f"{run}.pth": age})
        with (folder / "config.yaml").open("a") as file:
            file.write(f"train:\n  params:\n    network:\n      name: {network}\n")
        found = checkpoints.resolve_checkpoint("last", folder.parent, "HumanoidASE", network)
        assert found == str(folder / "nn" / f"{run}.pth")
    found = checkpoints.resolve_checkpoint("last", tmp_path / "runs", "HumanoidASE", "gen_amp")
    assert found.endswith("low.pth")


def test_last_looks_into_folders_of_runs(runs, tmp_path):
    runs("old", "Ant", {"Ant.pth": 300.0})
    new = runs("amp/first/walk1", "Ant", {"walk1.pth": 200.0})
    runs("amp/other", "HumanoidAMP", {"other.pth": 100.0})
    # Inside of a run folder is no other: what it has of its own kind are copies.
    runs("old/backup", "Ant", {"Ant.pth": 50.0})
    runs("1/2/3/4/5/6", "Ant", {"deep.pth": 10.0})
    found = checkpoints.resolve_checkpoint("last", tmp_path / "runs", "Ant")
    assert found == str(new / "nn" / "walk1.pth")


def test_last_reads_configurations_of_strangers_safely(runs, tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET", "Ant")
    hostile = ["task: {name: '${oc.env:SECRET}'}\n", "a: " + "[" * 3000, "a: &a [*a]\n"]
    for i, text in enumerate(hostile):
        (runs(f"hostile{i}", None, {"a.pth": 1.0}) / "config.yaml").write_text(text)
    good = runs("good", "Ant", {"Ant.pth": 300.0})
    found = checkpoints.resolve_checkpoint("last", tmp_path / "runs", "Ant")
    assert found == str(good / "nn" / "Ant.pth")


def test_a_damaged_run_folder_does_not_hide_the_others(runs, tmp_path):
    damaged = runs("damaged", None, {"a.pth": 1.0}) / "config.yaml"
    good = runs("good", "Ant", {"Ant.pth": 300.0})
    for config in [
        "",
        "- a\n- list\n",
        "task: HumanoidAMP\n",
        "task:\n",
        "task: {name: [",
        "a: ${b\n",
        "\x00",
    ]:
        damaged.write_text(config)
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


def test_a_wrong_path_is_named_with_a_hint(tmp_path):
    (tmp_path / "a.pth").write_bytes(b"x")
    with pytest.raises(CheckpointError, match=r"did you mean .*a\.pth\?") as caught:
        checkpoints.resolve_checkpoint(str(tmp_path / "a"), "runs", "Ant")
    assert "\n" not in str(caught.value)
    with pytest.raises(CheckpointError, match="no file"):
        checkpoints.resolve_checkpoint(str(tmp_path), "runs", "Ant")
