"""The shared folder: who may join, what is kept, what a broken or foreign file does."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.pbt_settings import PBTSettings, mutable_values, read_pbt_settings
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.pbt.workspace import MAX_RECORDS, Record, Workspace
from isaacgymenvs_lite.schema import plain

WORDS = ["task=Ant", "pbt=pbt_default", "pbt.num_policies=3", "pbt.workspace=ws", "rl_device=cpu"]
TREE = plain(compose(WORDS))
SETTINGS = read_pbt_settings(TREE)
assert SETTINGS is not None
PARAMS = mutable_values(TREE, SETTINGS)
STATE = {"model": {"w": torch.arange(3.0)}, "epoch": 1, "frame": 2}


def workspace(folder: Path, index: int = 0, tree: dict = TREE, **changed: object) -> Workspace:
    settings = replace(SETTINGS or PBTSettings(), policy_idx=index, **changed)
    return Workspace(folder / "runs" / "ws", settings, tree, PARAMS)


def record(iteration: int, objective: float = 1.0) -> Record:
    return Record(
        iteration=iteration,
        true_objective=objective,
        frame=iteration * 10,
        experiment_name="Ant_pbt",
        params=PARAMS,
    )


def joined(folder: Path, index: int, iterations: dict[int, float]) -> None:
    """Let a policy write records and end."""
    with workspace(folder, index) as own:
        own.join(is_new=True)
        for iteration, objective in iterations.items():
            own.write(record(iteration, objective), STATE)


def files(folder: Path) -> set[str]:
    """All files and empty folders."""
    found = [path for path in folder.rglob("*") if path.is_file() or not any(path.iterdir())]
    return {str(path.relative_to(folder)) for path in found}


def refusal(folder: Path, index: int = 2, **changed: object) -> str:
    before = files(folder)
    with pytest.raises(ConfigError) as error, workspace(folder, index, **changed) as own:
        own.join(is_new=True)
    assert files(folder) == before  # nothing half-written
    text = str(error.value)
    assert "\n" not in text and len(text) <= 500
    return text


def test_two_processes_of_one_policy(tmp_path):
    with workspace(tmp_path) as own:
        own.join(is_new=True)
        text = refusal(tmp_path, index=0)
        assert text.startswith("pbt.policy_idx=0: another run writes into")
        assert f"process {os.getpid()}" in text
        assert "give every process an index of its own" in text
    joined(tmp_path, 0, {1: 1.0})


def test_a_policy_that_was_trained(tmp_path):
    joined(tmp_path, 0, {1: 1.0})
    assert "policy 0 has been trained there; go on with it: resume=" in refusal(tmp_path, index=0)
    with workspace(tmp_path, 0) as own:
        own.join(is_new=False)
    description = (tmp_path / "runs/ws/000/policy.yaml").read_text()
    other = plain(compose([*WORDS, "train.params.network.mlp.units=[8]"]))
    with (
        pytest.raises(ConfigError, match="of another experiment"),
        workspace(tmp_path, 0, other) as own,
    ):
        own.join(is_new=False)
    assert (tmp_path / "runs/ws/000/policy.yaml").read_text() == description


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"num_policies": 4}, "pbt.num_policies is 3 there and 4 here"),
        ({"interval_steps": 5}, "pbt.interval_steps is 10000000 there and 5 here"),
        ({"mutation": {"train.params.config.gamma": "mutate_float"}}, "pbt.mutation is {'train"),
        ({"words": ["task=Humanoid"]}, "task is Ant there and Humanoid here"),
        (
            {"words": ["train.params.network.mlp.units=[8]"]},
            "train.params.network.mlp.units is [256, 128, 64] there and [8] here",
        ),
    ],
)
def test_another_experiment(tmp_path, changed, expected):
    joined(tmp_path, 0, {1: 1.0})
    if words := changed.pop("words", None):
        changed["tree"] = plain(compose([*WORDS, *words]))
    text = refusal(tmp_path, **changed)
    assert f"{tmp_path}/runs/ws/000/policy.yaml is of another experiment: {expected}" in text
    assert "choose another pbt.workspace" in text


@pytest.mark.parametrize("name", ["000", "best2", "002/000001.pth"])
def test_a_workspace_with_a_link_below_it(tmp_path, name):
    link = tmp_path / "runs/ws" / name
    link.parent.mkdir(parents=True)
    link.symlink_to(tmp_path)
    assert f"{link} is a link, " in refusal(tmp_path)


RECORD = (
    "iteration: 1\ntrue_objective: 1.0\nframe: 10\nexperiment_name: x\n"
    f"params: {dict.fromkeys(PARAMS, 0.5)}\n"
)
PATH = "train.params.config.gamma"


@pytest.mark.parametrize(
    "content",
    [
        "",
        "just a text",
        "iteration: [1",
        "a: !!python/object/apply:os.system [touch harm]",
        b"\xff\xfe\x00",
        "[" * 5000,
        "iteration: 1",
        RECORD.replace("frame: 10", "frame: -10"),
        RECORD.replace("objective: 1.0", "objective: .nan"),
        RECORD.replace("iteration: 1", "iteration: 3"),
        RECORD.replace("0.5", "'${oc.env:HOME}'"),
        RECORD.replace("0.5", ".inf"),
        RECORD.replace(f"'{PATH}'", "other"),
    ],
)
def test_a_broken_record_is_left_out(tmp_path, content, caplog):
    joined(tmp_path, 0, {1: 1.0})
    file = tmp_path / "runs/ws/000/000001.yaml"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with workspace(tmp_path, 1) as own:
        own.join(is_new=True)
        assert own.newest_records(5) == {}
    (message,) = caplog.messages
    assert f"{file} is broken: " in message and "\n" not in message


def test_a_broken_description_of_a_policy(tmp_path):
    joined(tmp_path, 0, {1: 1.0})
    (tmp_path / "runs/ws/000/policy.yaml").write_text("[")
    assert "000/policy.yaml is broken: " in refusal(tmp_path)


def test_the_oldest_records_go(tmp_path):
    with workspace(tmp_path, 0) as own:
        for iteration in range(1, MAX_RECORDS + 4):
            own.write(record(iteration), STATE)
    for suffix in ("pth", "yaml"):
        names = {path.stem for path in (tmp_path / "runs/ws/000").glob(f"0*.{suffix}")}
        assert names == {f"{number:06d}" for number in range(4, MAX_RECORDS + 4)}


def test_files_that_a_kill_left_half_written(tmp_path):
    joined(tmp_path, 0, {1: 1.0})
    partial = tmp_path / "runs/ws/000/.000002.yaml.7.partial"
    partial.write_text("itera")
    (tmp_path / "runs/ws/000/000002.pth").write_text("its record was not written")
    with workspace(tmp_path, 1) as own:
        own.join(is_new=True)
        assert own.newest_records(9) == {0: record(1)}
    with workspace(tmp_path, 0) as own:
        own.join(is_new=False)
    assert not partial.exists()


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "runs").write_text("a file")
    with pytest.raises(ConfigError) as error, workspace(tmp_path):
        pass
    assert "pbt.workspace=ws: " in str(error.value)
    assert "cannot be written (Not a directory); choose another folder of the runs" in str(
        error.value
    )


def test_the_best_of_the_population_is_kept(tmp_path):
    joined(tmp_path, 0, {1: 1.0, 2: -5.0, 3: 4.0, 4: 7.0, 5: 9.0, 6: 8.0})
    with workspace(tmp_path, 1) as own:
        for iteration, objective in ((2, -5.0), (1, 1.0), (2, -5.0), (3, 4.0), (4, 7.0), (5, 9.0)):
            own.keep_best(0, record(iteration, objective), "Ant")
        own.keep_best(0, record(6, 8.0), "Ant")
    best = tmp_path / "runs/ws/best1"
    objectives = sorted(
        yaml.safe_load(f.read_text())["true_objective"] for f in best.glob("*.yaml")
    )
    assert objectives == [4.0, 7.0, 9.0]
    assert {f.stem for f in best.glob("*.pth")} == {f.stem for f in best.glob("*.yaml")}
    assert (best / "Ant_best_obj_000000009.00000_iter_0005_policy000_frame50.pth").exists()
