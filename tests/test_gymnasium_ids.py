from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest

import isaacgymenvs_lite
from isaacgymenvs_lite import gymnasium_ids
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.tasks import isaacgym_task_map
from isaacgymenvs_lite.tasks.cartpole import Cartpole


def run_python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not done.stderr
    return done.stdout


def test_every_task_has_an_id():
    assert {gymnasium_ids.env_id(name) for name in isaacgym_task_map} <= set(gymnasium.registry)
    assert "IsaacGymEnvsLite/Classic-v0" not in gymnasium.registry


@pytest.mark.parametrize("order", ["isaacgymenvs_lite, gymnasium", "gymnasium, isaacgymenvs_lite"])
def test_the_order_of_imports_does_not_matter(order: str):
    printed = run_python(
        f"import sys, {order}\n"
        "import gymnasium.envs\n"
        "print('IsaacGymEnvsLite/Cartpole-v0' in gymnasium.registry, 'torch' in sys.modules,"
        " 'mujoco' in sys.modules, type(gymnasium.envs.__spec__.loader).__name__,"
        " 'CartPole-v1' in gymnasium.registry)"
    )
    assert printed.split() == ["True", "False", "False", "SourceFileLoader", "True"]


def test_importing_the_package_imports_nothing_large():
    printed = run_python(
        "import sys, isaacgymenvs_lite\n"
        "print(*({'gymnasium', 'numpy', 'torch', 'mujoco', 'hydra'} & set(sys.modules)))"
    )
    assert not printed.strip()


@pytest.fixture
def own_task(monkeypatch, tmp_path: Path) -> Path:
    """Register a task `Longpole`; return a folder with its file."""
    monkeypatch.setattr("isaacgymenvs_lite.tasks.registry.isaacgym_task_map", {})
    (tmp_path / "task").mkdir()
    file = tmp_path / "task" / "Longpole.yaml"
    file.write_text("defaults:\n  - Cartpole\n  - _self_\nname: Longpole\n")
    isaacgymenvs_lite.register_task("Longpole", Cartpole)
    yield tmp_path
    gymnasium.registry.pop("IsaacGymEnvsLite/Longpole-v0", None)


def test_a_registered_task_can_be_made(own_task: Path):
    name = "IsaacGymEnvsLite/Longpole-v0"
    envs = gymnasium.make_vec(name, num_envs=2, config_dir=own_task, num_threads=1)
    assert envs.reset(seed=1)[0].shape == (2, 4)
    envs.close()


def test_a_task_without_a_file_is_an_error_that_lists_the_files(own_task: Path):
    with pytest.raises(ConfigError, match=r"Longpole.*choices: .*Cartpole"):
        gymnasium.make_vec("IsaacGymEnvsLite/Longpole-v0", num_envs=2)
