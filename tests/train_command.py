"""train.py's command line in the test's own process, with a stand-in for the runner."""

from __future__ import annotations

import logging
import os
import sys
import types
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from isaacgymenvs_lite import train
from isaacgymenvs_lite.config.launch import CheckedConfig


def make_train_command(
    monkeypatch: pytest.MonkeyPatch, folder: Path, run: Callable[..., object]
) -> Callable[..., int]:
    """Return call(*words), which runs the command line in a folder and returns its exit code."""

    def run_tree(config: CheckedConfig, *arguments: object, **of_sweep: object) -> object:
        return run(config.cfg, *arguments, **of_sweep)

    stand_in = types.ModuleType("isaacgymenvs_lite.runner")
    stand_in.run = run_tree  # type: ignore[attr-defined]
    monkeypatch.chdir(folder)
    monkeypatch.setitem(sys.modules, "isaacgymenvs_lite.runner", stand_in)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")  # restored afterwards; the command line sets it
    monkeypatch.setenv("OMP_WAIT_POLICY", os.environ.get("OMP_WAIT_POLICY", "PASSIVE"))
    monkeypatch.setattr(logging.getLogger(), "handlers", [])

    def call(*arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["train.py", *arguments])
        try:
            train.main()
        except SystemExit as error:
            return int(error.code or 0)
        return 0

    return call
