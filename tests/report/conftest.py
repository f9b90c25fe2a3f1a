"""Run folders of made-up trainings."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from tensorboardX import SummaryWriter

from tests.benchmarks import conftest as benchmarks

write_events = benchmarks.write_events

CONFIG = """task:
  name: HumanoidAMP
  env: {motion_file: '<walk> & "run".npz'}
train:
  params:
    algo: {name: amp_agent}
    network: {name: amp}
"""
AMP = {
    "performance/total_fps": [100.0, 120.0, 110.0],
    "performance/step_inference_rl_update_fps": [100.0, 120.0, 110.0],
    "info/epochs": [1, 2, 3],
    "rewards/frame": [10.0, 20.0, 30.0],
    "rewards/step": [10.0, 20.0, 30.0],
    "rewards/iter": [10.0, 20.0, 30.0],
    "episode_lengths/frame": [20.0, 40.0, 60.0],
    "info/disc_reward_mean": [0.25, 0.5, 0.75],
    "info/fall_rate": [1.0, 0.5, 0.25],
    "info/off_clip_rate": [0.5, 0.4, 0.2],
    "info/disc_acc": [0.9, 0.8, 0.7],
    "info/disc_agent_acc": [0.95, 0.85, 0.75],
    "info/disc_demo_acc": [0.85, 0.75, 0.65],
    "info/last_lr": [5e-5, 5e-5, 5e-5],
    "info/kl": [0.01, float("nan"), 0.02],
    "losses/a_loss": [0.1, 0.0, -0.1],
    "losses/disc_loss": [1.5, 1.25, 1.0],
    "imitation/pose_error_m": [0.25, 0.125, 0.0625],
    "imitation/no_fall_share": [0.0, 0.5, 1.0],
    "imitation/tempo": [0.5, 0.75, 1.0],
    "goal/velocity_error_m_s": [0.9, 0.5, 0.25],
    "Episode/some": [1.0, 2.0, 3.0],
    "reward_terms/effort": [-0.25, -0.5, -0.75],
}
FEW = {"performance/total_fps": [100.0, 120.0], "rewards/step": [10.0, 20.0]}
"""The scalars of a page with few charts, which is drawn sooner."""
# As rl_games' PPO and SAC agents write them.
PPO = {
    "performance/step_inference_rl_update_fps": [1e4, 2e4, 3e4],
    "rewards/step": [1.0, 2.0, 3.0],
    "rewards/iter": [1.0, 2.0, 3.0],
    "rewards/time": [1.0, 2.0, 3.0],
    "episode_lengths/step": [5.0, 10.0, 15.0],
    "losses/c_loss": [3.0, 2.0, 1.0],
    "info/last_lr": [1e-3, 5e-4, 2.5e-4],
}

MakeRun = Callable[..., Path]


@pytest.fixture
def make_run(tmp_path: Path) -> MakeRun:
    """Return make(scalars, config=CONFIG, name="run"): three epochs of 100 frames."""

    def make(
        scalars: Mapping[str, Sequence[float]], config: str = CONFIG, name: str = "run"
    ) -> Path:
        run = tmp_path / "runs" / name
        (run / "nn").mkdir(parents=True)
        (run / "nn" / "last.pth").touch()
        if config:
            (run / "config.yaml").write_text(config)
        writer: Any = SummaryWriter(str(run / "summaries"))
        start = time.time()
        for tag, values in scalars.items():
            for i, value in enumerate(values):
                writer.add_scalar(tag, value, 100 * i, walltime=start + 60.0 * (i + 1))
        writer.close()
        return run

    return make
