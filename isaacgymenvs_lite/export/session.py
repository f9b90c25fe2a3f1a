"""From a checkpoint to a file."""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig

from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.env_factory import seed_everything
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.export.configuration import configuration_of
from isaacgymenvs_lite.export.exportable_policy import PolicyGraph, make_exportable_policy
from isaacgymenvs_lite.export.formats import FORMATS, ExportedPolicy
from isaacgymenvs_lite.export.metadata import describe
from isaacgymenvs_lite.runner import Session
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.utils.files import written_for_user

log = logging.getLogger(__name__)

_SEED = 1
_CHECKED_ROWS = 100
# float32 sums in another order.
_TOLERANCE = 1e-4


@dataclass(frozen=True, kw_only=True)
class ExportSettings:
    """Arguments of the command."""

    checkpoint: str = setting("")
    """A .pth file of a run, `last`, or the name of a shipped policy."""
    format: str = setting("onnx", choices=tuple(FORMATS))
    out: str = setting("")
    """File; '': the checkpoint's name with the format's suffix, in the working folder."""
    runs: str = setting("runs")
    """Folder of the runs, for `last`."""


def export_policy(settings: ExportSettings, overrides: Sequence[str] = ()) -> Path:
    """Write the policy of a checkpoint into one file and return its path.

    The file is run once and compared with the policy before anybody else does it.

    Args:
        settings: what and where to.
        overrides: of the configuration, as on the command line of train.py.

    Raises:
        UserError: a package is missing, the checkpoint or its configuration cannot be used, or the
            file cannot be written.
    """
    kind = FORMATS[settings.format]
    kind.check_packages(settings.format)
    cfg = configuration_of(settings.checkpoint, overrides, settings.runs)
    path = Path(settings.out or f"{Path(cfg.checkpoint).stem}{kind.suffix}")
    if path.suffix != kind.suffix:
        raise ConfigError(f"out={path}: expected a name that ends in {kind.suffix}")
    session = ExportSession(cfg)
    session.run()
    content = kind.write(session.graph, session.metadata)
    with written_for_user(path, "out") as partial:
        partial.write_bytes(content)
        difference = greatest_difference(session.graph, kind.load(partial), _CHECKED_ROWS)
        if not difference <= _TOLERANCE:
            raise ConfigError(
                f"{path}: not written, it would differ from the policy by {difference:.1g}: this"
                f" network cannot be exported as {settings.format}"
            )
    log.info("%s: %s", path, _summary(session.graph))
    log.info("%.2f MiB, differs from the policy by %.1g", len(content) / 2**20, difference)
    return path


class ExportSession(Session):
    """A session that plays nothing, but describes its policy.

    Attributes:
        graph: of the policy, once `run` was called.
        metadata: of the policy, once `run` was called.
    """

    def __init__(self, cfg: DictConfig) -> None:
        settings = check_config(cfg)
        seed_everything(_SEED)
        super().__init__(cfg, settings, _SEED)

    def _play(self) -> None:
        player = self.make_player()
        with contextlib.redirect_stdout(io.StringIO()):  # rl_games' normalisers tell their sizes
            self.graph = make_exportable_policy(player)
        state = load_checkpoint(self._checkpoint)
        name = str(self._cfg.task.name)
        self.metadata = describe(name, self._task, player, self.graph, self._params, state)


def greatest_difference(graph: PolicyGraph, exported: ExportedPolicy, num_rows: int) -> float:
    """Return the greatest difference of any output between an export and its policy."""
    with torch.random.fork_rng(devices=[]):
        inputs = {port.name: port.sample(num_rows) for port in graph.inputs}
    with torch.no_grad():
        found = graph(*inputs.values())
    expected = found if isinstance(found, tuple) else (found,)
    outputs = exported({name: rows.numpy() for name, rows in inputs.items()})
    return max(
        float(np.abs(outputs[port.name] - rows.numpy()).max())
        for port, rows in zip(graph.outputs, expected, strict=True)
    )


def _summary(graph: PolicyGraph) -> str:
    sides = [", ".join(port.name for port in ports) for ports in (graph.inputs, graph.outputs)]
    return " -> ".join(sides)
