"""Scripts that import isaacgymenvs, in a process of their own."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from isaacgymenvs_lite.paths import cfg_dir
from tests.tiny import TINY_DISCRIMINATOR

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


# Calls of the first releases: resolvers of the script's own, `runner.model_builder`, no seed.
FIRST_RELEASES = """\
import isaacgym
from omegaconf import OmegaConf
from isaacgymenvs.utils.rlgames_utils import RLGPUEnv, get_rlgames_env_creator
from isaacgymenvs.learning import amp_models, amp_network_builder
from isaacgymenvs_lite.config.compose import compose_task
from rl_games.torch_runner import Runner

OmegaConf.register_new_resolver("eq", lambda a, b: "own")
print(OmegaConf.create({"a": "${eq:1,2}"}).a)
runner = Runner()
builder = runner.model_builder
builder.model_factory.register_builder(
    "own", lambda network, **kwargs: amp_models.ModelAMPContinuous(network)
)
builder.network_factory.register_builder("own", lambda **kwargs: amp_network_builder.AMPBuilder())
section = {"name": "own", "mlp": {"units": [4], "activation": "relu"}}
print(type(runner.model_builder.load({"model": {"name": "own"}, "network": section})).__name__)
task = OmegaConf.to_container(compose_task("Cartpole", ["num_envs=2"]).task, resolve=True)
make = get_rlgames_env_creator(task, "Cartpole", "cpu", "cpu", -1, True, multi_gpu=False)
print(make().num_envs)
"""


def _run(tmp_path: Path, script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    (tmp_path / "script.py").write_text(script)
    (tmp_path / "neighbour.py").write_text("VALUE = 5\n")
    command = [sys.executable, "-m", "isaacgymenvs_lite", "alias", str(tmp_path / "script.py")]
    return subprocess.run(
        [*command, *arguments], capture_output=True, text=True, check=False, cwd=tmp_path
    )


def test_a_script_of_isaacgymenvs_runs_unchanged(tmp_path: Path) -> None:
    done = _run(tmp_path, FIRST_RELEASES + SCRIPT, "--headless", "x=1")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        *("own", "ModelAMPContinuous", "2"),
        "torch.Size([3, 4]) ['--headless', 'x=1'] 5",
    ]


def test_a_missing_script_is_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "isaacgymenvs_lite", "alias", str(tmp_path / "lost.py")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert "lost.py: no such file" in done.stderr


IMPORTS = """\
import isaacgym
from isaacgym import gymapi, gymtorch, gymutil
from isaacgym.torch_utils import *
import isaacgymenvs
from omegaconf import OmegaConf
texts = ["${if:${contains:X,ax},1,2}", "${resolve_default:3,}", "${eq:a,A}"]
assert OmegaConf.to_container(OmegaConf.create(texts), resolve=True) == [1, 3, True]
from isaacgymenvs.tasks.humanoid_amp import HumanoidAMP, build_amp_observations
from isaacgymenvs.tasks.amp.humanoid_amp_base import NUM_OBS, DOF_BODY_IDS, DOF_OFFSETS
from isaacgymenvs.tasks.amp.utils_amp.motion_lib import MotionLib
from isaacgymenvs.tasks.amp.utils_amp.amp_torch_utils import exp_map_to_quat
from isaacgymenvs.train import launch_rlg_hydra
import gym.spaces
from gym import spaces
import gymnasium
assert spaces is gymnasium.spaces and gym.Env is gymnasium.Env
import isaacgymenvs.tasks.amp.humanoid_amp as own
assert own.HumanoidAMP is HumanoidAMP
skeleton = MotionLib("walk", 28, [5, 8, 11, 14], "cpu").skeleton
assert (DOF_BODY_IDS, DOF_OFFSETS) == (list(skeleton.dof_body_ids), list(skeleton.dof_offsets))
try:
    gymapi.acquire_gym()
except Exception as error:
    print(error)
from isaacgymenvs.pbt.launcher.run_description import RunDescription
from isaacgymenvs.pbt.pbt import PbtAlgoObserver, initial_pbt_check
from isaacgymenvs.pbt.mutation import mutate_mini_epochs
class Own(PbtAlgoObserver): pass
assert mutate_mini_epochs(4, change_min=1.1, change_max=1.5) in (3, 5)
RunDescription("ant", experiments=[])
"""


def test_what_scripts_import_is_there_and_other_calls_say_what_to_do_instead(tmp_path) -> None:
    done = _run(tmp_path, IMPORTS)
    assert "isaacgym.gymapi.acquire_gym: Isaac Gym's tensor API does not exist" in done.stdout
    assert "docs/migration.md" in done.stdout
    last = done.stderr.strip().splitlines()[-1]
    assert "isaacgymenvs.pbt.launcher.run_description.RunDescription: processes are not" in last
    assert "start a training once for each policy, with pbt=pbt_default pbt.policy_idx=0" in last


# --- a fork's train.py ------------------------------------------------------------------------

TASK = """\
name: {task}
physics_engine: ${{..physics_engine}}
env: {{numEnvs: "${{resolve_default:4096,${{...num_envs}}}}", envSpacing: 5, {env}}}
sim:
  dt: 0.0166
  substeps: 2
  up_axis: "z"
  use_gpu_pipeline: ${{eq:${{...pipeline}},"gpu"}}
  gravity: [0.0, 0.0, -9.81]
  physx: {{num_threads: "${{....num_threads}}", use_gpu: "${{contains:cuda,${{....sim_device}}}}"}}
task: {{randomize: False}}
"""
# What differs from our files: everything is asked onto a GPU, and nothing is known of our keys.
CONFIG = """\
task_name: ${task.name}
experiment: ''
num_envs: ''
seed: 42
torch_deterministic: False
max_iterations: ''
physics_engine: 'physx'
pipeline: 'gpu'
sim_device: 'cuda:0'
rl_device: 'cuda:0'
graphics_device_id: 0
num_threads: 2
solver_type: 1
num_subscenes: 4
test: False
checkpoint: ''
sigma: ''
multi_gpu: False
wandb_activate: False
wandb_name: ${train.params.config.name}
capture_video: False
capture_video_freq: 1464
capture_video_len: 100
force_render: True
headless: False
a_key_of_the_fork: 1
defaults: [{task: Ant}, {train: "${task}PPO"}, {hydra/job_logging: disabled}, {pbt: no_pbt}]
hydra: {output_subdir: null, run: {dir: .}}
"""
ENVS = {
    "Cartpole": "resetDist: 3.0, maxEffort: 400.0, asset: {assetFileName: urdf/cartpole.urdf}",
    "Ant": "episodeLength: 1000, clipActions: 1.0, asset: {assetFileName: mjcf/nv_ant.xml}",
    "HumanoidAMP": "episodeLength: 300, motion_file: theirs.npz, numAMPObsSteps: 2",
}
SMALL_AMP = [
    *TINY_DISCRIMINATOR,
    "train.params.config.amp_minibatch_size=16",
    "train.params.network.mlp.units=[16]",
]


@pytest.fixture
def fork(tmp_path: Path, walk_clip: Path) -> Path:
    """Return a checkout's package: isaacgymenvs/train.py with a cfg/ of its own, and assets/."""
    package = tmp_path / "isaacgymenvs"
    for group in ("task", "train", "pbt"):
        (package / "cfg" / group).mkdir(parents=True)
    (package / "cfg" / "config.yaml").write_text(CONFIG)
    (package / "cfg" / "pbt" / "no_pbt.yaml").write_text("enabled: False\n")
    for task, env in ENVS.items():
        (package / "cfg" / "task" / f"{task}.yaml").write_text(TASK.format(task=task, env=env))
    for name in ("AntPPO", "CartpolePPO", "ClassicPPO", "HumanoidAMPPPO"):
        shutil.copy(cfg_dir() / "train" / f"{name}.yaml", package / "cfg" / "train")
    (tmp_path / "assets" / "amp" / "motions").mkdir(parents=True)
    shutil.copy(walk_clip, tmp_path / "assets" / "amp" / "motions" / "theirs.npz")
    shutil.copy(Path(__file__).with_name("fork_train.py"), package / "train.py")
    return package


def _train(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "isaacgymenvs_lite", "alias", "train.py", *words]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["Cartpole", "Ant", "HumanoidAMP"])
def test_a_fork_s_train_script_trains_and_plays_without_an_edit(task: str, fork: Path) -> None:
    sizes = ["num_envs=8", "headless=True", "train.params.config.minibatch_size=64"]
    words = [f"task={task}", *sizes, *(SMALL_AMP if task == "HumanoidAMP" else [])]
    trained = _train(fork, *words, "max_iterations=1")
    assert trained.returncode == 0, trained.stderr
    assert "MAX EPOCHS NUM" in trained.stdout
    assert "torch.compile: Disabled" in trained.stdout or torch.cuda.is_available()
    if not torch.cuda.is_available():
        said = "warning: rl_device=cuda:0: torch sees no GPU on this machine; the CPU is used"
        assert trained.stderr.splitlines().count(said) == 1
    (checkpoint,) = fork.glob(f"runs/{task}_*/nn/*.pth")
    if task != "Ant":  # one play is enough
        return
    played = _train(fork, *words, "test=True", f"checkpoint={checkpoint}")
    assert played.returncode == 0, played.stderr
    assert re.search(r"played \d+ episodes; reward", played.stderr)


@pytest.mark.slow
def test_a_fork_s_train_script_restarts_the_policy_of_a_population(fork: Path) -> None:
    """With its own observers and Runner: one that is replaced at every interval."""
    shutil.rmtree(fork / "cfg")
    shutil.copytree(cfg_dir(), fork / "cfg")
    sizes = ["num_envs=8", "train.params.config.minibatch_size=64", "rl_device=cpu"]
    pbt = ["pbt=pbt_default", "pbt.num_policies=1", "pbt.dbg_mode=True", "pbt.start_after=0"]
    times = ["pbt.interval_steps=256", "pbt.initial_delay=0", "pbt.mutation_rate=1"]
    short = ["task.env.resetDist=0.001", "+train.params.config.games_to_track=8"]
    done = _train(fork, "task=Cartpole", *sizes, *pbt, *times, *short, "max_iterations=4")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("pbt: policy 0 (objective -2) goes on with the weights") == 1
    (run,) = fork.glob("runs/Cartpole_pbt_00_*")
    assert len(list(run.glob("nn/last_Cartpole_ep_4_*.pth"))) == 1
    assert list(fork.glob("runs/pbt_workspace/000/000001.*"))


README = """\
import gym
import isaacgym
import isaacgymenvs
import torch

envs = isaacgymenvs.make(
    seed=0, task="Ant", num_envs=4, sim_device="cuda:0", rl_device="cuda:0",
    graphics_device_id=0, headless=False, multi_gpu=False, virtual_screen_capture=True,
    force_render=False,
)
envs.is_vector_env = True
envs = gym.wrappers.RecordVideo(
    envs, "./videos", step_trigger=lambda step: step % 10000 == 0, video_length=3
)
envs.reset()
print(envs.render(mode="rgb_array").shape)
for _ in range(3):
    envs.step(2.0 * torch.rand((4,) + envs.action_space.shape, device="cuda:0") - 1.0)
"""


@pytest.mark.slow
@pytest.mark.usefixtures("gl")
def test_a_script_that_records_on_a_gpu_runs_on_any_machine(tmp_path: Path) -> None:
    done = _run(tmp_path, README)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "(480, 640, 3)"
    assert (tmp_path / "videos" / "rl-video-step-0.mp4").stat().st_size > 0
