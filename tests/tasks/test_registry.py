"""Tasks of one's own: registered by a program, or offered by an installed package."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import isaacgymenvs_lite
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.tasks import find_task, isaacgym_task_map, register_task
from isaacgymenvs_lite.tasks.cartpole import Cartpole

REPOSITORY = Path(__file__).resolve().parents[2]
GUIDE = REPOSITORY / "docs" / "own_task.md"


class Mine(Cartpole):
    """Somebody's task."""


@pytest.fixture(autouse=True)
def _same_map() -> Iterator[None]:
    before = dict(isaacgym_task_map)
    yield
    isaacgym_task_map.clear()
    isaacgym_task_map.update(before)


def _code_of_guide(language: str) -> list[str]:
    """Return the code blocks of the guide in a language, in order."""
    blocks = GUIDE.read_text().split(f"```{language}\n")[1:]
    return [block.split("```")[0] for block in blocks]


def test_a_registered_task_is_made_by_its_name(make_task) -> None:
    isaacgymenvs_lite.register_task("Mine", Mine)
    task = make_task("task=Cartpole", "task.name=Mine")
    assert type(task) is Mine


def test_a_name_is_not_taken_by_mistake() -> None:
    register_task("Mine", Mine)
    register_task("Mine", Mine)  # a module that is imported twice
    with pytest.raises(ConfigError, match=r"register_task\('Cartpole'\): .* already has this name"):
        register_task("Cartpole", Mine)
    assert isaacgym_task_map["Cartpole"] is Cartpole
    register_task("Cartpole", Mine, replace=True)
    assert isaacgym_task_map["Cartpole"] is Mine


def test_an_unknown_name_lists_the_choices_and_says_how_to_add_one() -> None:
    with pytest.raises(ConfigError, match=r"'Cartpoll' \(did you mean 'Cartpole'\?\).*own_task.md"):
        find_task("Cartpoll")


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """The guide's examples, laid out as pip installs them."""
    site = tmp_path / "site"
    (site / "pendulum_tasks").mkdir(parents=True)
    (site / "pendulum_tasks" / "__init__.py").write_text("")
    (site / "pendulum_tasks" / "pendulum.xml").write_text(_code_of_guide("xml")[0])
    info = site / "pendulum_tasks-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: pendulum-tasks\nVersion: 0.1\n")
    entries = ["[isaacgymenvs_lite.tasks]"]
    swing_up, _script, dribble = _code_of_guide("python")
    yaml_blocks = iter(_code_of_guide("yaml"))
    for group in ("task", "train"):
        (tmp_path / "cfg" / group).mkdir(parents=True)
    for task, module, code in (
        ("SwingUp", "swing_up", swing_up),
        ("RobotDribble", "dribble", dribble),
        ("HumanoidDribble", "dribble", dribble),
    ):
        (site / "pendulum_tasks" / f"{module}.py").write_text(code)
        entries.append(f"{task} = pendulum_tasks.{module}:{task}")
        (tmp_path / "cfg" / "task" / f"{task}.yaml").write_text(next(yaml_blocks))
        train_file = next(yaml_blocks, None)  # HumanoidDribble has none of its own
        if train_file is not None:
            (tmp_path / "cfg" / "train" / f"{task}PPO.yaml").write_text(train_file)
    (info / "entry_points.txt").write_text("\n".join(entries) + "\n")
    return tmp_path


def _train(package: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(package / "site"), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(REPOSITORY / "train.py"), *words]
    return subprocess.run(
        command, cwd=package, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_the_guides_task_trains_as_an_external_package(package: Path) -> None:
    words = ("task=SwingUp", "num_envs=16", "max_iterations=2", "num_threads=1")
    done = _train(package, "--config-dir", str(package / "cfg"), *words)
    assert done.returncode == 0, done.stderr
    assert list(package.glob("runs/SwingUp_*/nn/SwingUp.pth"))


@pytest.mark.slow
def test_the_guides_goal_trains_as_an_external_package(package: Path) -> None:
    words = ["--config-dir", str(package / "cfg"), "task=RobotDribble", "num_envs=64"]
    words += ["num_threads=1", "max_iterations=1", "task.env.episodeLength=16"]
    words += ["train.params.config.minibatch_size=128", "train.params.config.amp_minibatch_size=64"]
    done = _train(package, *words, "train.params.config.imitation_frequency=1")
    assert done.returncode == 0, done.stderr
    assert list(package.glob("runs/RobotDribble_*/nn/RobotDribble.pth"))
    assert re.search(r"ball_speed_error_m_s \d\.\d+", done.stdout + done.stderr)


@pytest.mark.slow
@pytest.mark.parametrize("train", ["HumanoidHeadingAMP", "HumanoidASEHRLPPO"])
def test_the_guides_goal_trains_on_the_humanoid_both_ways(package: Path, train: str) -> None:
    words = ["--config-dir", str(package / "cfg"), "task=HumanoidDribble", f"train={train}"]
    words += ["num_envs=16", "num_threads=1", "max_iterations=1", "experiment=dribble"]
    done = _train(package, *words, "train.params.config.minibatch_size=128")
    assert done.returncode == 0, done.stderr
    assert list(package.glob("runs/dribble_*/nn/dribble.pth"))


@pytest.mark.slow
def test_an_entry_point_that_cannot_be_imported_is_named(package: Path) -> None:
    (package / "site" / "pendulum_tasks" / "swing_up.py").write_text("import lost_module\n")
    done = _train(package, "--config-dir", str(package / "cfg"), "task=SwingUp", "num_envs=2")
    assert done.returncode == 2
    assert "task.name=SwingUp: pendulum_tasks" in done.stderr
    assert "lost_module" in done.stderr
