"""The humanoid's model, and a few real humanoids."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import pytest
import torch

from isaacgymenvs_lite.env_factory import make_from_config
from isaacgymenvs_lite.paths import assets_dir
from tests.tiny import ONE_THREAD, composed


@pytest.fixture(scope="session")
def humanoid() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(assets_dir() / "mjcf" / "amp_humanoid.xml"))


@pytest.fixture
def make_env(walk_clip: Path) -> Iterator[Callable[..., Any]]:
    """Return make(*overrides), a task of three humanoids, reset."""
    envs = []

    def make(*overrides: str) -> Any:
        torch.manual_seed(0)
        size = ("num_envs=3", *ONE_THREAD)
        cfg = composed(["task=HumanoidAMP", f"task.env.motion_file={walk_clip}", *size, *overrides])
        env = make_from_config(cfg, sim_device="cpu", rl_device="cpu")
        envs.append(env)
        env.reset()
        return env

    yield make
    for env in envs:
        env.close()
