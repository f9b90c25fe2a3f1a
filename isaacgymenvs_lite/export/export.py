"""Writes the policy of a checkpoint into a file, and compares the two."""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.export.configuration import configuration_of
from isaacgymenvs_lite.export.exportable_policy import PolicyGraph, make_exportable_policy
from isaacgymenvs_lite.export.formats import FORMATS, ExportedPolicy
from isaacgymenvs_lite.export.metadata import describe
from isaacgymenvs_lite.export.scene import scene_of
from isaacgymenvs_lite.runner import load_player
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.utils.files import written_for_user

log = logging.getLogger(__name__)

_CHECKED_ROWS = 100
# Runtimes add float32 numbers in other orders.
_TOLERANCE = 1e-4


@dataclass(frozen=True, kw_only=True)
class ExportSettings:
    """Arguments of the command."""

    checkpoint: str = setting("")
    """A .pth file of a run, `last`, or the name of a shipped policy."""
    format: str = setting("onnx", choices=tuple(FORMATS))
    out: str = setting("")
    """File; '': in the working folder the checkpoint's name, of `last` `policy`, with the format's
    suffix."""
    runs: str = setting("runs")
    """Folder of the runs, for `last`."""


def export_policy(settings: ExportSettings, overrides: Sequence[str] = ()) -> Path:
    """Write the policy of a checkpoint into one file and return its path.

    The file is run once and compared with the policy. The model of a robot's task is written beside
    it, see `scene_of`.

    Args:
        settings: of the command.
        overrides: of the configuration, as on the command line of train.py.

    Raises:
        UserError: a package is missing, the checkpoint or its configuration cannot be used, or the
            file cannot be written.
    """
    kind = FORMATS[settings.format]
    kind.check_packages(settings.format)
    cfg = configuration_of(settings.checkpoint, overrides, settings.runs)
    name = "policy" if settings.checkpoint == "last" else Path(cfg.checkpoint).stem
    path = Path(settings.out or f"{name}{kind.suffix}")
    if path.suffix != kind.suffix:
        raise ConfigError(f"out={path}: expected a name that ends in {kind.suffix}")
    with load_player(cfg) as player:
        with contextlib.redirect_stdout(io.StringIO()):  # rl_games' normalisers print their sizes
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
    """Return the greatest difference of any output between an export and its policy."""
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
