"""`make`, with a clip of the test in the place of the shipped one."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import DictConfig

import isaacgymenvs_lite
from isaacgymenvs_lite import env_factory as making
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.errors import ConfigError, DeviceError, MotionFileError
from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP
from isaacgymenvs_lite.tasks.base.vec_task import VecTask


@pytest.fixture(autouse=True)
def _in_the_folder_of_the_clip(walk_clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The task file asks for walk.npz, which is looked for in the working directory first.
    monkeypatch.chdir(walk_clip.parent)


@pytest.fixture
def make() -> Iterator:
    made: list[VecTask] = []

    def _make(*args, **arguments) -> VecTask:
        made.append(isaacgymenvs_lite.make(*args, **arguments))
        return made[-1]

    yield _make
    for task in made:
        task.close()


def test_arguments_are_those_of_isaacgymenvs_all_with_defaults() -> None:
    parameters = inspect.signature(isaacgymenvs_lite.make).parameters
    assert list(parameters) == [
        "seed",
        "task",
        "num_envs",
        "sim_device",
        "rl_device",
        "graphics_device_id",
        "headless",
        "multi_gpu",
        "virtual_screen_capture",
        "force_render",
        "cfg",
    ]
    assert all(p.default is not inspect.Parameter.empty for p in parameters.values())
    assert parameters["task"].default == "HumanoidAMP"
    assert parameters["cfg"].default is None


def test_the_defaults_make_the_task_file_s_environments(make) -> None:
    task = make()
    assert isinstance(task, HumanoidAMP)
    assert task.num_envs == 512  # of the task file, on a CPU
    assert task.max_episode_length == 300
    assert task.headless
    assert task.motion_lib.get_motion_length([0]).tolist() == [1.5]  # the clip of the test


def test_keywords(make) -> None:
    task = make(task="HumanoidAMP", num_envs=3)
    assert task.num_envs == 3
    observations, done_ids = task.reset_done()
    assert observations["obs"].shape == (3, 105)
    assert len(done_ids) == 3
    _, rewards, _, infos = task.step(torch.zeros(3, 28))
    assert rewards.tolist() == [1.0] * 3
    assert infos["amp_obs"].shape == (3, 210)


def test_positions(make, monkeypatch) -> None:
    opened = []

    class Window:
        def __init__(self, env, *_, every_step) -> None:
            opened.append((env, every_step))

        def close(self) -> None:
            opened.clear()

    monkeypatch.setattr(making, "check_display", lambda: None)
    monkeypatch.setattr(making, "Window", Window)
    task = make(7, "HumanoidAMP", 2, "cpu", "cpu", 0, False, False, False, False)
    assert opened == [(task, False)]
    assert task.num_envs == 2
    assert not task.headless
    assert task.graphics_device_id == 0


def test_what_is_captured_needs_no_display(gl, make, monkeypatch) -> None:
    def check_display() -> None:
        raise AssertionError("a window was wanted")

    monkeypatch.setattr(making, "check_display", check_display)
    task = make(task="Cartpole", num_envs=2, headless=False, virtual_screen_capture=True)
    assert task.listeners == []
    task.reset()
    picture = task.render(mode="rgb_array")
    assert (picture.shape, picture.dtype) == ((480, 640, 3), np.uint8)


def _course(task: VecTask) -> bytes:
    first = task.reset_done()[0]["obs"]
    actions = 0.1 * torch.randn(task.num_envs, 28)
    second = task.step(actions)[0]["obs"]
    return first.numpy().tobytes() + second.numpy().tobytes()


def test_a_seed_gives_the_same_course_and_another_one_another(make) -> None:
    courses = [_course(make(seed=seed, num_envs=4)) for seed in (3, 3, 4)]
    assert courses[0] == courses[1]
    assert courses[0] != courses[2]


def test_an_unknown_task_lists_the_choices() -> None:
    with pytest.raises(ConfigError, match=r"HumanoidAMPP.*HumanoidAMP") as error:
        isaacgymenvs_lite.make(task="HumanoidAMPP")
    assert "\n" not in str(error.value)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_learning_on_a_gpu_that_is_not_there_says_how_to_go_on(make) -> None:
    for arguments in ({"num_envs": 2}, {"cfg": _tree("rl_device=cpu")}):
        with pytest.raises(DeviceError, match=r"rl_device=cuda:0: .*; use rl_device=cpu$"):
            make(rl_device="cuda:0", sim_device="cuda:0", **arguments)


def test_physics_asked_onto_a_gpu_runs_on_the_cpu_and_says_so(make, caplog) -> None:
    caplog.set_level(logging.INFO)
    task = make(num_envs=2, sim_device="cuda:0")
    assert task.device.type == "cpu"
    (said,) = (message for message in caplog.messages if "sim_device" in message)
    assert "physics runs on the CPU" in said
    with pytest.raises(DeviceError, match="sim_device=gpu: expected cpu, cuda or cuda:N"):
        make(num_envs=2, sim_device="gpu")


# --- with a composed tree ---------------------------------------------------------------------


def _tree(*overrides: str) -> DictConfig:
    return compose(["task=HumanoidAMP", "num_envs=2", "num_threads=1", *overrides])


def test_a_composed_tree_says_what_to_make(make) -> None:
    tree = _tree("task.env.episodeLength=50", "task.sim.substeps=3", "task.env.stateInit=Start")
    task = make(cfg=tree, num_envs=99)
    assert task.num_envs == 2  # the tree's, as is said in the docstring
    assert task.max_episode_length == 50
    assert task.simulation.substeps == 6
    assert task.simulation.num_threads == 1
    # The tree is not written to.
    assert "numObservations" not in tree.task.env


def test_errors_of_the_task_come_through() -> None:
    for override, error in (
        ("task.env.motion_file=nowhere.npz", MotionFileError),
        ("task.env.numAMPObsSteps=1", ConfigError),
        ("task.env.asset.assetFileName=nothing.xml", ConfigError),
        ("task.env.contactBodies=[tail]", ConfigError),
    ):
        with pytest.raises(error) as found:
            isaacgymenvs_lite.make(cfg=_tree(override))
        assert "\n" not in str(found.value)
