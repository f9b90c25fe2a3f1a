"""The options of Isaac Lab's scripts, as typed there."""

from __future__ import annotations

import time

import pytest
import torch
import yaml

from isaacgymenvs_lite.workflows.playing import _in_real_time
from isaacgymenvs_lite.workflows.sb3 import LIBRARY as SB3

SMALL = ("--num_envs", "4", "--headless", "num_threads=1")


def test_the_tutorials_options_are_taken(library, run_train, run_play, tmp_path, caplog):
    words = ("--enable_cameras", "--device", "cpu", "--livestream", "0", "--keep_all_info")
    more = ("--log_interval", "64", "--agent", f"{library.name}_cfg_entry_point")
    task = ("--task", "IsaacGymEnvsLite/Cartpole-v0", "--kit_args", "--a=1")
    run_train(library, *SMALL, "--max_iterations", "1", *words, *more, *task[:2])
    assert "--enable_cameras, --keep_all_info: nothing to do for it here" in caplog.text
    (folder,) = (tmp_path / "logs" / library.name / "Cartpole").iterdir()
    assert yaml.safe_load((folder / "params/env.yaml").read_text())["rl_device"] == "cpu"
    told = run_play(library, *SMALL, *task[:2], "--enable_cameras", "--ml_framework", "torch")
    assert "episodes: 4, " in told  # of the newest checkpoint, without being asked for it


def test_livestream_is_the_page(library, run_train, caplog):
    words = ("--livestream", "2", "viewer_port=0")
    run_train(library, *SMALL, "--max_iterations", "1", *words)
    assert "watch it at http://localhost:" in caplog.text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--distributed",), "--distributed: a training is one process"),
        (("--xr",), "use viewer=web"),
        (("--visualizer", "kit"), "--visualizer: use headless=False"),
        (("--resume",), "--resume: use --checkpoint FILE"),
        (("--load_run", "x"), "--load_run: use --checkpoint FILE"),
        (("--livestream", "7"), "--livestream: invalid choice"),
        (
            ("--max_iteratons", "3"),
            "unrecognized arguments: --max_iteratons 3 (did you mean '--max_i",
        ),
        (("--num_envs", "0"), "expected a whole number >= 1"),
        (("--device", "gpu"), "--device=gpu: expected cpu, cuda or cuda:N"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_other_options_are_answered_in_one_line(run_train, fails, words, message):
    pytest.importorskip("stable_baselines3")
    assert message in fails(run_train, SB3, *SMALL, *words)


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_device_that_is_not_there_is_one_line(library, run_train, fails):
    line = fails(run_train, library, *SMALL, "--device", "cuda:0")
    assert "--device=cuda:0: torch sees no GPU on this machine; use --device=cpu" in line


def test_the_log_can_be_written_less_often(run_train, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    pytest.importorskip("stable_baselines3")
    steps = []
    for interval in ("128", "512"):  # a rollout is 32 x 4 frames
        logs = tmp_path / interval
        words = ("--max_iterations", "8", "--log_interval", interval)
        run_train(SB3, *SMALL, *words, "--logs", str(logs))
        (folder,) = (logs / "sb3" / "Cartpole").iterdir()
        events = EventAccumulator(str(folder))
        events.Reload()
        steps.append(len(events.Scalars("time/fps")))
    assert steps[0] > 2 * steps[1] > 0


def test_real_time_waits():
    begun: list[float] = []
    step = _in_real_time(lambda: begun.append(time.monotonic()), dt_s=0.02)
    for _ in range(4):
        step()
    assert begun[-1] - begun[0] >= 0.055
