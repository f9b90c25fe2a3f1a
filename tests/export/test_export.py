"""The command, from a run folder to a file that plays as the policy does."""

from __future__ import annotations

import json
import logging
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import seed_everything
from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.evaluation.evaluate import EvaluationResult, evaluate
from isaacgymenvs_lite.export import export
from isaacgymenvs_lite.export.__main__ import main
from isaacgymenvs_lite.export.export import ExportSettings, configuration_of, export_policy
from isaacgymenvs_lite.export.formats import ExportedPolicy, load_policy
from isaacgymenvs_lite.runner import load_player, run
from tests.tiny import CONFIG, TINY_PPO, train_in

CARTPOLE = (
    "task=Cartpole",
    *TINY_PPO,
    "num_envs=16",
    "max_iterations=3",
    "task.env.maxEffort=100",  # not the default: a policy must find it as it was
    f"{CONFIG}.horizon_length=8",
    f"{CONFIG}.normalize_input=True",
)


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the run of a short training of Cartpole."""
    folder = tmp_path_factory.mktemp("project")
    train_in(folder, CARTPOLE)
    return folder


def test_a_run_in_a_folder_of_its_own_is_exported(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    run(compose([*CARTPOLE, "max_iterations=1", "num_envs=2", "experiment=small/poles"]))
    (file,) = tmp_path.glob("runs/small/poles_*/nn/poles.pth")
    cfg = configuration_of("last", ["task=Cartpole"], "runs")
    assert cfg.checkpoint == str(max(file.parent.iterdir(), key=lambda f: f.stat().st_mtime))
    assert cfg.task.env.maxEffort == 100
    assert main(["checkpoint=last", "task=Cartpole", "format=torchscript", "out=poles.pt"]) == 0
    assert (tmp_path / "poles.pt").is_file()


@pytest.fixture
def checkpoint(project: Path) -> Path:
    (file,) = project.glob("runs/*/nn/Cartpole.pth")
    return file


def play(cfg: Any, num_envs: int, policy: ExportedPolicy | None = None) -> EvaluationResult:
    """An episode in each environment with a policy, or with the player if there is none."""
    cfg.task.env.numEnvs = num_envs
    with load_player(cfg) as player:
        act = player.act if policy is None else numpy_policy(policy)
        seed_everything(3)
        return evaluate(player.env, act, num_envs)


def numpy_policy(policy: ExportedPolicy) -> Callable[[dict[str, Tensor]], Tensor]:
    return lambda obs: torch.from_numpy(policy({"obs": obs["obs"].numpy()})["action"].copy())


def test_a_run_that_is_watched_is_exported_without(checkpoint):
    """Its training may still be there and have the port of the page."""
    words = ["viewer=web", "headless=False", "capture_video=True"]
    cfg = configuration_of(str(checkpoint), words, "runs")
    assert (cfg.viewer, cfg.headless, cfg.capture_video) == ("", True, False)


def test_an_export_that_differs_is_not_left_behind(checkpoint, tmp_path, monkeypatch):
    monkeypatch.setattr(export, "_TOLERANCE", -1.0)  # nothing is as near as that
    out = tmp_path / "policy.pt"
    with pytest.raises(ConfigError, match=r"policy\.pt: not written, it would differ"):
        export_policy(
            ExportSettings(checkpoint=str(checkpoint), format="torchscript", out=str(out))
        )
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_file_earns_what_the_player_earns(
    project, checkpoint, tmp_path, monkeypatch, caplog
) -> None:
    pytest.importorskip("onnxruntime")
    monkeypatch.chdir(project)
    file = tmp_path / "policy.onnx"
    with caplog.at_level(logging.INFO):
        assert main(["checkpoint=last", "task=Cartpole", f"out={file}"]) == 0
    assert f"checkpoint: {checkpoint}\n" in caplog.text
    assert f"task and train settings: {checkpoint.parents[1] / 'config.yaml'}" in caplog.text
    assert "policy.onnx: obs -> action" in caplog.text
    policy = load_policy(file)
    cfg = configuration_of(str(checkpoint), (), "runs")
    expected = play(cfg, 16)
    found = play(cfg, 16, policy)
    assert expected.num_episodes == found.num_episodes == 16
    assert found.steps == expected.steps
    assert found.reward == pytest.approx(expected.reward, rel=1e-4)

    metadata = policy.metadata
    assert metadata["task"] == "Cartpole"
    assert metadata["algorithm"] == "a2c_continuous"
    assert metadata["frames"] == 3 * 8 * 16
    assert metadata["control_rate_hz"] == pytest.approx(60.0, rel=0.01)
    assert metadata["observation_limit"] == 5.0
    assert metadata["action_limit"] == 1.0
    names = ["cart_pos", "cart_vel", "pole_angle", "pole_vel"]
    expected_groups = [
        {"name": name, "age": 0, "start": i, "size": 1, "frame": None}
        for i, name in enumerate(names)
    ]
    assert metadata["observations"] == expected_groups
    assert metadata["actions"] == ["slider_to_cart"]
    assert metadata["action_scaling"] == {"unit": "N", "offset": [0.0], "scale": [100.0]}
    assert metadata["drives"] == [
        {
            "name": "slider_to_cart",
            "joint": "slider_to_cart",
            "gear": [1.0, 0.0, 0.0],
            "stiffness": 0.0,
            "damping": 0.0,
            "effort_limit": 1000.0,
            "armature": 0.0,
        }
    ]
    joints = ["slider_to_cart", "cart_to_pole"]
    assert [joint["name"] for joint in metadata["joints"]] == joints
    assert [joint["type"] for joint in metadata["joints"]] == ["slide", "hinge"]
    assert metadata["root"] is None
    assert not list(tmp_path.glob("*_scene.xml"))  # it is no robot
    json.dumps(metadata)


def test_a_shipped_policy_walks(tmp_path) -> None:
    """Metadata of the humanoid, and what a file does with the clip's own motion."""
    file = export_policy(
        ExportSettings(checkpoint="walk", format="torchscript", out=str(tmp_path / "walk.pt"))
    )
    policy = load_policy(file)
    cfg = configuration_of("walk", ["task.env.episodeLength=40"], "runs")
    expected, found = play(cfg, 2), play(cfg, 2, policy)
    assert found.steps == expected.steps
    assert found.imitation is not None
    assert expected.imitation is not None
    assert found.imitation.pose_error_m == pytest.approx(expected.imitation.pose_error_m, abs=1e-3)

    metadata = policy.metadata
    assert metadata["control_rate_hz"] == pytest.approx(30.1, abs=0.1)
    assert metadata["actions"][:3] == ["abdomen_x", "abdomen_y", "abdomen_z"]
    assert metadata["action_scaling"]["unit"] == "rad"
    knee = metadata["actions"].index("right_knee")
    assert metadata["drives"][knee]["stiffness"] == 300.0
    assert metadata["drives"][knee]["effort_limit"] is None
    assert metadata["action_scaling"]["scale"][0] == pytest.approx(np.pi)
    assert metadata["simulation"]["steps_per_action"] == 4
    assert metadata["simulation"]["timestep_s"] == pytest.approx(0.0083)
    assert metadata["key_bodies"] == ["right_hand", "left_hand", "right_foot", "left_foot"]
    assert metadata["root"]["default_qpos"] == pytest.approx([0, 0, 0.89, 1, 0, 0, 0])
    assert metadata["root"]["start_qvel"][0] > 0.5  # m/s: the clip walks along x
    assert [joint["type"] for joint in metadata["joints"][:3]] == ["ball", "ball", "ball"]
    assert all(joint["default_qpos"] == [1, 0, 0, 0] for joint in metadata["joints"][:3])
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "walk_scene.xml"))
    assert [drive["name"] for drive in metadata["drives"]] == [
        model.actuator(i).name for i in range(model.nu)
    ]
    last = metadata["observations"][-1]
    assert last["start"] + last["size"] == 105


def test_settings_of_the_run_and_what_was_typed(checkpoint, project, monkeypatch) -> None:
    monkeypatch.chdir(project)
    cfg = configuration_of(str(checkpoint), (), "runs")
    assert (cfg.task.name, cfg.task.env.maxEffort, cfg.test) == ("Cartpole", 100, True)
    cfg = configuration_of("last", ["task=Cartpole", "task.env.maxEffort=50"], "runs")
    assert (cfg.task.env.maxEffort, cfg.checkpoint) == (50, str(checkpoint))
    assert cfg.train.params.network.mlp.units == [16, 8]
    # a train file of one's own stands for all settings
    cfg = configuration_of(str(checkpoint), ["task=Cartpole", "train=CartpolePPO"], "runs")
    assert cfg.task.env.maxEffort == 400
    # so does another task
    assert configuration_of(str(checkpoint), ["task=Ant"], "runs").task.name == "Ant"


def test_a_mistake_is_one_line(project, monkeypatch, capsys) -> None:
    pytest.importorskip("onnxruntime")
    monkeypatch.chdir(project)
    (project / "taken").write_text("a file")
    for words, message in (
        ("", "checkpoint= is missing; give .*walk"),
        ("checkpoint=absent.pth", "no file"),
        ("checkpoint=last task.env.maxEfort=1", "task.env.maxEfort"),
        ("checkpoint=last train=AntPPO", "no checkpoint of task=HumanoidAMP "),
        ("checkpoint=last task=Cartpole out=x.pt", "ends in .onnx"),
        ("checkpoint=last task=Cartpole out=taken/x.pt format=torchscript", "x.pt: cannot be"),
        ("checkpoint=last format=caffe", "expected one of onnx, torchscript"),
    ):
        with pytest.raises(SystemExit) as caught:
            main(words.split())
        assert caught.value.code == 2
        line = capsys.readouterr().err.splitlines()[-1]
        assert re.search(f"^error: .*{message}", line), line


def test_last_is_the_same_file_for_all(project, checkpoint, tmp_path, monkeypatch, caplog) -> None:
    """Going on with a training, playing and exporting, by the same words."""
    folder = tmp_path / "project"
    shutil.copytree(project, folder)
    expected = str(folder / checkpoint.relative_to(project))
    file = tmp_path / "mine.yaml"
    file.write_text("defaults: [Cartpole, _self_]\n")
    monkeypatch.chdir(folder)
    words = [f"task={file}", "train=CartpolePPO"]
    assert configuration_of("last", words, "runs").checkpoint == expected
    for change in ("test=True", "max_iterations=4"):  # the training makes a newer one
        caplog.clear()
        with caplog.at_level(logging.INFO):
            run(compose([*words, *CARTPOLE[1:], "checkpoint=last", change]))
        assert f"checkpoint: {expected}" in caplog.messages


def test_last_is_of_any_task_and_named_policy(project, checkpoint, tmp_path, monkeypatch) -> None:
    shutil.copytree(project / "runs", tmp_path / "runs")
    monkeypatch.chdir(tmp_path)
    assert main(["checkpoint=last", "format=torchscript"]) == 0
    assert load_policy("policy.pt").metadata["task"] == "Cartpole"
    cfg = configuration_of("last", (), "runs")
    assert cfg.task.name == "Cartpole"
    assert cfg.checkpoint == str(tmp_path / checkpoint.relative_to(project))


def test_last_without_any_run(tmp_path) -> None:
    with pytest.raises(
        CheckpointError, match=r"no checkpoint of any task below.*isaacgymenvs.lite train"
    ):
        configuration_of("last", (), str(tmp_path))
