"""Configuration files: task and train files, in training and in play, and those of run folders."""

from __future__ import annotations

import contextlib
import io
import random
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf

from benchmarks.fuzz import hostile_clips
from benchmarks.fuzz.kinds import Kind, Mutator
from benchmarks.fuzz.mutators import mutate_yaml
from isaacgymenvs_lite.checkpoints.files import resolve_checkpoint
from isaacgymenvs_lite.checkpoints.run_config import read_run_config
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.config.train_files import load_train_file
from isaacgymenvs_lite.config.train_params import apply_wrapper_limits, prepare_train_params
from isaacgymenvs_lite.env_factory import make_from_config
from isaacgymenvs_lite.errors import CheckpointError
from isaacgymenvs_lite.paths import cfg_dir
from isaacgymenvs_lite.registration import build_runner, known_names
from isaacgymenvs_lite.run.memory import check_training_memory
from isaacgymenvs_lite.runner import load_player
from isaacgymenvs_lite.wrappers.rl_games_env import RLGPUEnv

_CONFIG = "params.config"
_TINY_PPO: dict[str, Any] = {
    "params.network.mlp.units": [16, 8],
    f"{_CONFIG}.mixed_precision": False,
    f"{_CONFIG}.horizon_length": 4,
    f"{_CONFIG}.minibatch_size": 8,
    f"{_CONFIG}.mini_epochs": 1,
}
_TINY_AMP: dict[str, Any] = {
    **_TINY_PPO,
    "params.network.disc.units": [12, 6],
    f"{_CONFIG}.amp_batch_size": 16,
    f"{_CONFIG}.amp_obs_demo_buffer_size": 16,
    f"{_CONFIG}.amp_replay_buffer_size": 64,
}
_TINY_ASE = {
    **_TINY_AMP,
    "params.network.style.units": [10, 6],
    "params.network.enc.units": [8],
}
_TINY_SAC: dict[str, Any] = {
    "params.network.mlp.units": [16, 8],
    f"{_CONFIG}.mixed_precision": False,
    f"{_CONFIG}.batch_size": 16,
    f"{_CONFIG}.replay_buffer_size": 200,
}
_TINY_LSTM: dict[str, Any] = {**_TINY_PPO, "params.network.rnn.units": 8}
# Task, train file, and what makes the train file small.
_PAIRS: tuple[tuple[str, str, Mapping[str, Any]], ...] = (
    ("Cartpole", "CartpolePPO", _TINY_PPO),
    ("Quadcopter", "QuadcopterPPO", _TINY_PPO),
    ("Humanoid", "HumanoidPPO", _TINY_PPO),
    ("AnymalTerrain", "AnymalTerrainPPO_LSTM", _TINY_LSTM),
    ("AntSAC", "AntSAC", _TINY_SAC),
    ("HumanoidAMP", "HumanoidAMPPPO", _TINY_AMP),
    ("HumanoidASE", "HumanoidASEPPO", _TINY_ASE),
)
# Brings the section that a task file may have beside its own.
_RANDOMIZED = ("Humanoid", "HumanoidRandomization")
_BROKEN_VALUES: tuple[Any, ...] = (
    *(float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 1e-308, -1, 0, 0.5, 2**31, 2**40),
    *(2**62, -(2**62), 10**12, "text", "", None, [], {}, [1, 2, 3], ["a"], {"a": 1}, True, False),
    *("nan", "1e400", [[]], "\u202e", "../../etc/passwd", "${a.b}", "${..x}", "${oc.env:HOME}"),
    *("x" * 3000, [float("nan")] * 3, [1e308] * 3, [2**40], [-1], [0], [16] * 500),
)


def _tree(group: str, name: str, changes: Mapping[str, Any]) -> str:
    """Return a file of cfg/ with some values changed, as text."""
    content = yaml.safe_load((cfg_dir() / group / f"{name}.yaml").read_text(encoding="utf-8"))
    for path, value in changes.items():
        *above, key = path.split(".")
        section = content
        for part in above:
            section = section.setdefault(part, {})
        section[key] = value
    return yaml.safe_dump(content, sort_keys=False)


def _write_trains(folder: Path) -> list[Path]:
    paths = []
    for _, train, changes in _PAIRS:
        path = folder / f"{train}.yaml"
        path.write_text(_tree("train", train, changes), encoding="utf-8")
        paths.append(path)
    return paths


def _write_tasks(folder: Path) -> list[Path]:
    paths = []
    for name, _, _ in _PAIRS:
        path = folder / f"My{name}.yaml"  # a file of its own name would name itself
        changes: dict[str, Any] = {}
        if name == _RANDOMIZED[0]:
            section = yaml.safe_load(_tree("task", _RANDOMIZED[1], {}))["task"]
            changes = {"task": {**section, "randomize": True}}
        path.write_text(_tree("task", name, changes), encoding="utf-8")
        paths.append(path)
    return paths


def _mutate_values(data: bytes, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """Replace one or two values of a YAML text, wherever they are; or break it as any YAML."""
    if rng.random() < 0.35:
        return mutate_yaml(data, rng, others)
    tree = yaml.safe_load(data)
    for _ in range(rng.choice((1, 1, 2))):
        places = list(_places(tree))
        if not places:  # a hostile file without a mapping
            break
        section, key = rng.choice(places)
        if rng.random() < 0.1 and isinstance(section, dict):
            del section[key]
        else:
            section[key] = rng.choice(_BROKEN_VALUES)
    return yaml.safe_dump(tree, sort_keys=False).encode()


def _places(tree: Any) -> Iterable[tuple[Any, Any]]:
    """Yield each section and key of nested dictionaries and lists."""
    keys: Iterable[Any] = ()
    if isinstance(tree, dict):
        keys = list(tree)
    elif isinstance(tree, list):
        keys = range(len(tree))
    for key in keys:
        yield tree, key
        yield from _places(tree[key])


def _compose(*words: str) -> DictConfig:
    return compose([*words, "num_envs=2", "num_threads=1", "rl_device=cpu"])


@contextlib.contextmanager
def opened_agent(cfg: DictConfig) -> Iterator[tuple[Any, Any]]:
    """Give the runner and the agent of a tree, before its first epoch, without a run folder.

    Raises:
        UserError: the tree cannot be used.
    """
    check_config(cfg)
    apply_wrapper_limits(cfg)
    task = make_from_config(cfg, sim_device="cpu", rl_device="cpu")
    try:
        params = prepare_train_params(
            cfg,
            num_envs=task.num_envs,
            seed=1,
            run_name="fuzz",
            rl_device="cpu",
            num_agents=task.num_agents,
            num_states=task.num_states,
            names=known_names(build_runner()),
        )
        check_training_memory(params, task, task.num_envs)
        params["torch_threads"] = 1
        runner, vec_env = build_runner(), RLGPUEnv.from_task(task)
        with contextlib.redirect_stdout(io.StringIO()), tempfile.TemporaryDirectory() as folder:
            params["config"]["train_dir"] = folder
            runner.load({"params": params})
            runner.params["config"] |= {"vec_env": vec_env, "env_info": vec_env.get_env_info()}
            agent = runner.algo_factory.create(
                runner.algo_name, base_name="run", params=runner.params
            )
            yield runner, agent
            agent.writer.close()
    finally:
        task.close()


def _task_of(path: Path) -> str:
    """Return the task that a broken train file still belongs to, by its names."""
    text = path.read_text(encoding="utf-8", errors="replace")
    found = [task for task, _, _ in _PAIRS if f"resolve_default:{task}," in text]
    return max(found, key=len, default="Cartpole")


def _train(path: Path) -> None:
    """Read a train file and a task that it fits, up to the agent."""
    with opened_agent(_compose(f"task={_task_of(path)}", f"train={path}")):
        pass


def _play(path: Path) -> None:
    """Read a train file to play with it, up to the first observation."""
    cfg = _compose(f"task={_task_of(path)}", f"train={path}", "test=True")
    with load_player(cfg) as player:
        player.act(player.env.reset())


def _simulate(path: Path) -> None:
    """Read a task file, and make a step."""
    cfg = _compose(f"task={path}", "train=CartpolePPO")
    check_config(cfg)
    task = make_from_config(cfg, sim_device="cpu", rl_device="cpu")
    try:
        task.reset()
        task.step(task.zero_actions())
    finally:
        task.close()


def _read_alone(path: Path) -> None:
    """Read a train file as a hierarchical agent does for its low level."""
    load_train_file(path)


def _write_run_configs(folder: Path) -> list[Path]:
    paths = []
    for task, train, _ in _PAIRS[:1] + _PAIRS[-2:]:
        path = folder / f"{task}.yaml"
        path.write_text(
            OmegaConf.to_yaml(_compose(f"task={task}", f"train={train}")), encoding="utf-8"
        )
        paths.append(path)
    return paths


def _read_run(path: Path) -> None:
    """Read the config.yaml of a run folder as `checkpoint=last`, `export` and packing do."""
    runs = path.parent.with_name(f"{path.parent.name}_runs")
    run = runs / "run"
    (run / "nn").mkdir(parents=True, exist_ok=True)
    shutil.copy(path, run / "config.yaml")
    (run / "nn" / "run.pth").write_bytes(b"")
    with contextlib.suppress(CheckpointError):  # a damaged run is left out
        resolve_checkpoint("last", runs, "Cartpole", "actor_critic")
    read_run_config(path, {})


def _texts(canary: Path) -> Iterable[tuple[str, bytes]]:
    """Yield texts that ask for more than there is, or for code."""
    yield from hostile_clips.yaml_texts(canary)
    yield "alias_of_itself", b"params: &a {config: *a}\n"
    yield "names_itself", b"defaults: [input]\nparams: {}\n"
    yield "names_secret", b"params: {config: {name: '${oc.env:HOME}'}}\n"
    yield "grown", b"params: {a: '${.b}${.b}', b: '${.c}${.c}', c: '${.d}${.d}', d: '${.a}'}\n"
    yield "nan_key", b".nan: 1\nparams: {.inf: 2}\n"


def _kind(
    name: str, originals: Any, load: Any, mutate: Mutator = _mutate_values, **more: Any
) -> Kind:
    # Settings are named by their paths in the tree: train.params.config.gamma.
    return Kind(name, ".yaml", originals, load, mutate, _texts, names_file=False, **more)


def _check(path: Path) -> list[str]:
    return ["isaacgymenvs_lite.check", str(path), f"task={_task_of(path)}", "num_envs=2"]


KINDS = (
    _kind("train_files", _write_trains, _train, command=_check),
    _kind("played_train_files", _write_trains, _play),
    _kind("train_files_alone", _write_trains, _read_alone, mutate_yaml),
    _kind("task_files", _write_tasks, _simulate),
    _kind("run_folders", _write_run_configs, _read_run),
)
