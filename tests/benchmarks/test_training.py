from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from benchmarks.experiments import Experiment
from benchmarks.runs import Run, start_now
from benchmarks.training import Plan, Training, log_file, plan, train_all
from isaacgymenvs_lite.checkpoints.run_config import resumed_tree
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.errors import ConfigError

WALK = Experiment("walk", ("task=HumanoidAMP", "task.env.motion_file=walk"))
CORES = sorted(os.sched_getaffinity(0))[:1]


@pytest.fixture
def run(tmp_path) -> Run:
    return Run.of(tmp_path, "walk", 3)


@pytest.fixture
def trained(run, write_events) -> Run:
    """Return a run that trained two epochs in two minutes and saved twice."""
    run.note_start(start_now(WALK.settings, "train.py", [0]))
    write_events(run.folder / "summaries", [10.0, 20.0])
    (run.folder / "nn").mkdir()
    for age_s, name in ((50, "HumanoidAMP.pth"), (10, "last_HumanoidAMP_ep_2_rew_20.0.pth")):
        file = run.folder / "nn" / name
        file.touch()
        written_s = time.time() - age_s
        os.utime(file, (written_s, written_s))
    return run


# --- what a run is to do ----------------------------------------------------------------------


def test_a_new_run_gets_all_minutes(run):
    for resume in [False, True]:
        assert plan(WALK, run, 5.0, resume) == Plan(run, WALK.settings, None, 5.0)


def test_a_resumed_run_goes_on_from_the_newest_checkpoint_for_what_is_left(trained):
    job = plan(WALK, trained, 5.0, resume=True)
    assert job.checkpoint == trained.folder / "nn" / "last_HumanoidAMP_ep_2_rew_20.0.pth"
    assert job.minutes == 3.0


def test_minutes_of_all_parts_count_together(trained, write_events):
    write_events(trained.folder / "summaries", [30.0], first_epoch=2, start_s=99_000.0)
    assert plan(WALK, trained, 5.0, resume=True).minutes == 2.0
    assert plan(WALK, trained, 3.4, resume=True).minutes == 0.0  # not worth a start
    assert plan(WALK, trained, 3.6, resume=True).minutes == pytest.approx(0.6)
    assert plan(WALK, trained, 1.0, resume=True).minutes == 0.0


def test_a_run_is_not_overwritten(trained):
    with pytest.raises(ConfigError, match=r"holds a training already; --resume"):
        plan(WALK, trained, 5.0, resume=False)


def test_a_run_is_not_resumed_with_other_settings(trained):
    other = Experiment("walk", (*WALK.settings, "num_envs=64"))
    with pytest.raises(ConfigError, match=r"with other settings, different: num_envs=64; give"):
        plan(other, trained, 5.0, resume=True)


def test_the_command_composes_and_names_the_folder(run, tmp_path):
    words = plan(WALK, run, 5.0, resume=False).command([4, 7])
    assert words[0] == sys.executable
    assert Path(words[1]).name == "train.py"
    cfg = compose(words[2:])
    assert cfg.full_experiment_name == "walk_seed3"
    assert cfg.train.params.config.train_dir == str(tmp_path)
    assert (cfg.seed, cfg.num_threads, cfg.train.params.torch_threads) == (3, 2, 2)


def test_a_run_goes_on_in_its_own_folder(trained):
    words = Plan(trained, WALK.settings, None, 5.0).command([4])
    OmegaConf.save(compose(words[2:]), trained.folder / "config.yaml")
    cfg = resumed_tree(plan(WALK, trained, 5.0, resume=True).command([4, 7])[2:])
    assert cfg.resume == str(trained.newest_checkpoint())
    assert (cfg.seed, cfg.num_threads, cfg.train.params.torch_threads) == (3, 2, 2)


# --- one process ------------------------------------------------------------------------------

# The stand-in ends like train.py after SIGINT with exit code 0. A second SIGINT ends it with 9.
STAND_IN = """
import os, signal, sys, time
asked = []
def handle(*_):
    asked.append(1)
    if len(asked) == 2:
        sys.exit(9)
signal.signal(signal.SIGINT, handle)
print("threads", os.environ["OMP_NUM_THREADS"], "cpus", sorted(os.sched_getaffinity(0)), flush=True)
while not asked:
    time.sleep(0.01)
if "--slow" in sys.argv:
    time.sleep(30)
print("saved", flush=True)
"""


class HandClock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def wait_for(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline, "did not happen"
        time.sleep(0.01)


@pytest.fixture
def start(run):
    """Return a function that starts a training of the stand-in and waits until it runs."""
    started = []

    def make(minutes: float, clock: HandClock, *arguments: str, **more: Any) -> Training:
        command = [sys.executable, "-c", STAND_IN, *arguments]
        training = Training(Plan(run, WALK.settings, None, minutes, **more), CORES, command, clock)
        started.append(training)
        wait_for(lambda: "cpus" in log_file(run).read_text())
        return training

    yield make
    for training in started:
        training.close()


def test_a_process_ends_by_the_clock_with_a_checkpoint(start, run):
    clock = HandClock()
    training = start(2.0, clock)
    clock.now_s = 119.9
    assert training.poll(stop=False) is None
    time.sleep(0.1)
    assert training.poll(stop=False) is None
    clock.now_s = 120.0
    wait_for(lambda: training.poll(stop=False) is not None)
    assert training.poll(stop=False) == 0  # SIGINT was sent once
    assert log_file(run).read_text().splitlines()[-1] == "saved"


def test_a_process_ends_before_its_time_when_it_is_over(start, run):
    clock, over = HandClock(), []
    training = start(60.0, clock, is_over=lambda curve: bool(over))
    clock.now_s = 100.0
    for _ in range(20):
        assert training.poll(stop=False) is None
        time.sleep(0.01)
    over.append(1)
    clock.now_s = 200.0
    wait_for(lambda: training.poll(stop=False) is not None)
    assert training.poll(stop=False) == 0
    assert log_file(run).read_text().splitlines()[-1] == "saved"


# --- several processes ------------------------------------------------------------------------


class FakeTraining:
    """A training that ends after a number of polls."""

    def __init__(self, job: Plan, polls: int, code: int = 0) -> None:
        self.run = job.run
        self.closed = False
        self._polls, self._code = polls, code

    def poll(self, stop: bool) -> int | None:
        self._polls -= 1
        return self._code if stop or self._polls < 0 else None

    def close(self) -> None:
        self.closed = True


@pytest.fixture(autouse=True)
def no_sleep(monkeypatch):
    from benchmarks import training

    monkeypatch.setattr(training, "_POLL_S", 0.0)


@pytest.fixture
def plans(tmp_path) -> list[Plan]:
    return [Plan(Run.of(tmp_path, "walk", seed), (), None, 1.0) for seed in range(5)]


def test_each_place_has_one_run_at_a_time_and_all_get_their_turn(plans):
    events: list[tuple[str, int, int]] = []

    class Noting(FakeTraining):
        def __init__(self, job: Plan, cores) -> None:
            super().__init__(job, polls=1 + job.run.seed % 2, code=int(job.run.seed == 3))
            self.cores = cores
            events.append(("start", job.run.seed, cores[0]))

        def poll(self, stop: bool) -> int | None:
            code = super().poll(stop)
            if code is not None:
                events.append(("end", self.run.seed, self.cores[0]))
            return code

    failed = train_all(plans, [[0], [1]], lambda: False, Noting, say=lambda line: None)
    assert [run.seed for run in failed] == [3]
    assert [seed for kind, seed, _ in events if kind == "start"] == [0, 1, 2, 3, 4]
    for core in (0, 1):
        kinds = [kind for kind, _, c in events if c == core]
        assert kinds == ["start", "end"] * (len(kinds) // 2)


def test_an_error_leaves_no_process_behind(plans):
    started: list[FakeTraining] = []

    def start(job: Plan, cores) -> FakeTraining:
        if started:
            raise KeyboardInterrupt
        started.append(FakeTraining(job, polls=10**9))
        return started[-1]

    with pytest.raises(KeyboardInterrupt):
        train_all(plans, [[0], [1]], lambda: False, start, lambda line: None)
    assert started[0].closed
