"""Scripts that import isaacgymenvs, in a process of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SCRIPT = """\
import isaacgym
import isaacgymenvs
import sys
import torch
import neighbour
from isaacgym.torch_utils import quat_rotate, to_torch
from isaacgymenvs.tasks import isaacgym_task_map
from isaacgymenvs.tasks.base.vec_task import VecTask
from isaacgymenvs.utils.reformat import omegaconf_to_dict, print_dict
from isaacgymenvs.utils.rlgames_utils import RLGPUAlgoObserver, get_rlgames_env_creator
from isaacgymenvs.utils.torch_jit_utils import compute_rot, quat_mul, unscale
from isaacgymenvs.utils.utils import set_np_formatting, set_seed
import isaacgymenvs_lite.tasks.base.vec_task as own

assert own.VecTask is VecTask  # one class, not two copies of it
assert own.__spec__.name == "isaacgymenvs_lite.tasks.base.vec_task"
envs = isaacgymenvs.make(seed=0, task="Cartpole", num_envs=3, sim_device="cpu", rl_device="cpu")
envs.reset()
obs, rewards, dones, infos = envs.step(torch.zeros(3, 1))
print(obs["obs"].shape, sys.argv[1:], neighbour.VALUE)
"""


def _run(tmp_path: Path, script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    (tmp_path / "script.py").write_text(script)
    (tmp_path / "neighbour.py").write_text("VALUE = 5\n")
    command = [sys.executable, "-m", "isaacgymenvs_lite.alias", str(tmp_path / "script.py")]
    return subprocess.run([*command, *arguments], capture_output=True, text=True, check=False)


def test_a_script_of_isaacgymenvs_runs_unchanged(tmp_path: Path) -> None:
    done = _run(tmp_path, SCRIPT, "--headless", "x=1")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "torch.Size([3, 4]) ['--headless', 'x=1'] 5"


def test_the_simulators_own_calls_say_what_to_do(tmp_path: Path) -> None:
    done = _run(tmp_path, "from isaacgym import gymapi\ngymapi.acquire_gym()\n")
    assert done.returncode == 1
    assert "isaacgym.gymapi.acquire_gym: Isaac Gym's tensor API does not exist" in done.stderr
    assert "docs/migration.md" in done.stderr


def test_modules_that_do_not_exist_are_named(tmp_path: Path) -> None:
    done = _run(tmp_path, "import isaacgymenvs.tasks.factory\n")
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert "isaacgymenvs_lite has no module isaacgymenvs_lite.tasks.factory" in last


def test_a_missing_script_is_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "isaacgymenvs_lite.alias", str(tmp_path / "lost.py")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert "lost.py: no such file" in done.stderr
