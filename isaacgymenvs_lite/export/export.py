"""Writes the policy of a checkpoint into a file, and compares this file with the policy."""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf, open_dict

from isaacgymenvs_lite.checkpoints.files import (
    checkpoint_of_tree,
    load_checkpoint,
    resolve_checkpoint,
)
from isaacgymenvs_lite.checkpoints.policy_arguments import as_override, complete_arguments
from isaacgymenvs_lite.checkpoints.run_config import read_run_config, run_config_file
from isaacgymenvs_lite.config.compose import changed_by, compose
from isaacgymenvs_lite.errors import ConfigError, one_line
from isaacgymenvs_lite.export.exportable_policy import PolicyGraph, make_exportable_policy
from isaacgymenvs_lite.export.formats import FORMATS, ExportedPolicy
from isaacgymenvs_lite.export.metadata import describe
from isaacgymenvs_lite.paths import shipped_policies
from isaacgymenvs_lite.runner import load_player
from isaacgymenvs_lite.schema import plain, setting
from isaacgymenvs_lite.tasks.base.mjcf_task import MjcfTask
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.utils.files import written_for_user

_NUM_ENVS = 2
# Settings that replace settings of the training for the export.
_PLAIN = {
    "test": True,
    "num_envs": _NUM_ENVS,
    "num_threads": 1,
    "rl_device": "cpu",
    "sim_device": "cpu",
    "pipeline": "cpu",
    "multi_gpu": False,
    "headless": True,
    "force_render": False,
    "viewer": "",
    "capture_video": False,
    "wandb_activate": False,
    "seed": 1,
    "torch_deterministic": False,
    "latent": "",
    "sigma": "",
    "experiment": "",
}


def configuration_of(checkpoint: str, overrides: Sequence[str], runs: str) -> DictConfig:
    """Return the tree that plays a policy on the CPU in a few environments.

    The file of a shipped policy contains its settings; the settings of a checkpoint in a run folder
    are in the run's config.yaml. With `train=`, or with `task=` of another task, the tree is
    composed from the task file and the train file.

    Args:
        checkpoint: a path, the name of a shipped policy, or `last`. `last` selects the newest
            checkpoint of all runs, or of the task and train file that the overrides name.
        overrides: settings as on the command line of train.py.
        runs: folder of all runs.
    """
    if not checkpoint:
        raise ConfigError(
            "checkpoint= is missing; give a .pth file of a run, 'last', or a shipped policy:"
            f" {', '.join(shipped_policies())}"
        )
    typed = dict(word.split("=", 1) for word in overrides if "=" in word)
    is_shipped = checkpoint in shipped_policies()
    # The task and the meaning of `last` follow the rules of train.py.
    composes = "task" in typed or (checkpoint == "last" and "train" in typed)
    composed = compose(overrides) if composes else None
    if composed is None or is_shipped:
        path = resolve_checkpoint(checkpoint, runs, "")
    else:
        path = checkpoint_of_tree(plain(composed), checkpoint, runs)
    file = run_config_file(Path(path))
    if not is_shipped and file.is_file() and "train" not in typed:
        model = load_checkpoint(path).get("model", {})
        cfg = OmegaConf.create(read_run_config(file, model, to_play=True))
        if composed is None or composed.task.name == cfg.task.name:
            log.info("task and train settings: %s", file)
            words = [word for word in overrides if not word.startswith("task=")]
            return _for_export(changed_by(cfg, words), path)
    named = checkpoint if is_shipped else as_override(path)
    words = complete_arguments(["test=True", f"checkpoint={named}", *overrides])
    return _for_export(compose(words), path)


def _for_export(cfg: DictConfig, path: str) -> DictConfig:
    with open_dict(cfg):
        for key, value in {**_PLAIN, "checkpoint": path}.items():
            cfg[key] = value
        cfg.task.env.numEnvs = _NUM_ENVS
    return cfg


_FIRST_LINE = "<!-- Written by isaacgymenvs_lite.export: what the policy was trained in. -->\n"


@dataclass(frozen=True)
class Scene:
    """The robot with its drives and sensors on the floor, as MJCF.

    `assets` maps file names to meshes and textures; the name of their folder begins like `path`.
    """

    path: Path
    text: str
    assets: dict[str, bytes]

    def write(self) -> None:
        """Write the MJCF, the meshes and the textures."""
        for name, content in self.assets.items():
            with written_for_user(self.path.with_suffix("") / name, "out") as partial:
                partial.write_bytes(content)
        with written_for_user(self.path, "out") as partial:
            partial.write_text(self.text, encoding="utf-8")


def scene_of(task: VecTask, policy: Path) -> Scene | None:
    """Return the model for `<policy>_scene.xml`, or None if the task is not a robot's task.

    If MuJoCo cannot write the model, a warning is logged and the result is None, because the policy
    does not need the model.

    Raises:
        ConfigError: a file of this name exists, but an export has not written this file.
    """
    if not isinstance(task, MjcfTask) or task.robot_description() is None:
        return None
    path = policy.with_name(f"{policy.stem}_scene.xml")
    if path.is_file() and not path.read_bytes().startswith(_FIRST_LINE.encode()):
        raise ConfigError(
            f"{path} exists and was not written by an export; choose another out=, because the"
            " policy's scene would have this name"
        )
    try:
        spec = task.scene()
        if spec is None:
            return None
        assets = dict(spec.assets)
        if assets:
            spec.meshdir = spec.texturedir = path.stem
        return Scene(path, _FIRST_LINE + spec.to_xml(), assets)
    except (ValueError, mujoco.FatalError) as error:
        log.warning("%s: not written, because MuJoCo cannot write it: %s", path, one_line(error))
        return None


log = logging.getLogger(__name__)

_CHECKED_ROWS = 100
# Largest difference of the outputs; runtimes add float32 values in different orders.
_TOLERANCE = 1e-4


@dataclass(frozen=True, kw_only=True)
class ExportSettings:
    """Arguments of the command."""

    checkpoint: str = setting("")
    """A .pth file of a run, `last`, or the name of a shipped policy."""
    format: str = setting("onnx", choices=tuple(FORMATS))
    out: str = setting("")
    """Path of the exported file. '' selects the working folder and the name of the checkpoint, or
    `policy` for `last`, with the suffix of the format."""
    runs: str = setting("runs")
    """Folder of all runs, in which `last` finds the newest checkpoint."""


def export_policy(settings: ExportSettings, overrides: Sequence[str] = ()) -> Path:
    """Write the policy of a checkpoint into one file and return the file's path.

    The exported policy is run once and compared with the original policy. The model of a robot's
    task is written into the same folder, see `scene_of`. The overrides are settings as on
    train.py's command line.
    """
    kind = FORMATS[settings.format]
    kind.check_packages(settings.format)
    cfg = configuration_of(settings.checkpoint, overrides, settings.runs)
    name = "policy" if settings.checkpoint == "last" else Path(cfg.checkpoint).stem
    path = Path(settings.out or f"{name}{kind.suffix}")
    if path.suffix != kind.suffix:
        raise ConfigError(f"out={path}: expected a name that ends in {kind.suffix}")
    with load_player(cfg) as player:
        with contextlib.redirect_stdout(io.StringIO()):  # rl_games' normalisers print shapes.
            graph = make_exportable_policy(player)
        metadata = describe(cfg, player, graph, load_checkpoint(cfg.checkpoint))
        scene = scene_of(player.env, path)
    content = kind.write(graph, metadata)
    with written_for_user(path, "out") as partial:
        partial.write_bytes(content)
        difference = greatest_difference(graph, kind.load(partial), _CHECKED_ROWS)
        if not difference <= _TOLERANCE:
            raise ConfigError(
                f"{path}: not written, it would differ from the policy by {difference:.1g}: this"
                f" network cannot be exported as {settings.format}"
            )
    sides = (", ".join(spec.name for spec in specs) for specs in (graph.inputs, graph.outputs))
    log.info("%s: %s", path, " -> ".join(sides))
    log.info("%.2f MiB, differs from the policy by %.1g", len(content) / 2**20, difference)
    if scene is not None:
        scene.write()
        log.info("%s: the robot as it was simulated, for play_onnx.py", scene.path)
    return path


def greatest_difference(graph: PolicyGraph, exported: ExportedPolicy, num_rows: int) -> float:
    """Return the largest difference between the outputs of a policy and of its exported file."""
    with torch.random.fork_rng(devices=[]):
        inputs = {spec.name: spec.sample(num_rows) for spec in graph.inputs}
    with torch.no_grad():
        found = graph(*inputs.values())
    expected = found if isinstance(found, tuple) else (found,)
    outputs = exported({name: rows.numpy() for name, rows in inputs.items()})
    return max(
        float(np.abs(outputs[spec.name] - rows.numpy()).max())
        for spec, rows in zip(graph.outputs, expected, strict=True)
    )
