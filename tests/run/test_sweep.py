"""Sweeps: `train.py -m` with a stand-in for the runner, with the real one, and with Optuna."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from hydra.errors import MissingConfigException
from omegaconf import DictConfig
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from isaacgymenvs_lite import runner, train
from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from isaacgymenvs_lite.config.compose import compose, explain
from isaacgymenvs_lite.config.staging import StagedFiles
from isaacgymenvs_lite.errors import MotionFileError, SweepError
from tests.tiny import CONFIG, TINY_AMP, TINY_PPO, fast_and_slow, train_in
from tests.train_command import make_train_command

REPOSITORY = Path(__file__).resolve().parents[2]
CARTPOLE = ("task=Cartpole", *TINY_PPO)
OPTUNA = (
    *("hydra/sweeper=optuna", "hydra.sweeper.n_jobs=1", "hydra.sweeper.n_trials=8"),
    *("hydra.sweeper.direction=maximize", "hydra.sweeper.sampler.seed=1"),
)
Call = Callable[..., int]
SWEEP_FILES = ["runs", "runs/sweep", "runs/sweep/jobs.csv", "runs/sweep/multirun.yaml"]


class Jobs:
    """Runs jobs in place of `runner.run`: a job returns its seed, unless a test sets more."""

    def __init__(self) -> None:
        self.seeds: list[int] = []
        self.directions: set[str] = set()
        self.results: dict[int, Any] = {}
        self.stopped_by: int | None = None

    def run(self, cfg: DictConfig, command: Any, *, stop: Any, direction: str) -> float | None:
        assert command.is_job
        self.seeds.append(cfg.seed)
        self.directions.add(direction)
        if cfg.seed == self.stopped_by:
            with stop:
                signal.raise_signal(signal.SIGINT)
        result = self.results.get(cfg.seed, float(cfg.seed))
        if isinstance(result, Exception):
            raise result
        return result


@pytest.fixture
def jobs() -> Jobs:
    return Jobs()


@pytest.fixture
def call(monkeypatch, tmp_path, jobs) -> Call:
    """Run the command line in an empty folder; returns the exit code."""
    return make_train_command(monkeypatch, tmp_path, jobs.run)


def lines(capsys) -> list[str]:
    return capsys.readouterr().err.splitlines()


def files(folder: Path) -> list[str]:
    """Everything below a folder, without the dates of sweeps."""
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*"))
    return sorted("runs/sweep/" + n.split("/")[2] if n.count("/") > 1 else n[:10] for n in names)


def test_the_numbers_are_listed_at_the_end(call, jobs, capsys, tmp_path):
    jobs.results = {2: None}
    assert call("-m", "task=Cartpole", "seed=1,2,3") == 0
    shown = lines(capsys)
    assert shown[-3:] == [
        "job #0 seed=1: 1",
        "job #1 seed=2: nothing was measured",
        "job #2 seed=3: 3",
    ]
    assert jobs.directions == {""}
    assert files(tmp_path) == SWEEP_FILES


def test_a_failed_job_does_not_end_the_others(call, jobs, capsys):
    jobs.results = {1: MotionFileError("walk.npy: truncated"), 3: ValueError("a bug")}
    assert call("-m", "task=Cartpole", "seed=1,2,3,4") == train.EXIT_FAILED_JOBS
    assert jobs.seeds == [1, 2, 3, 4]
    output = capsys.readouterr().err
    assert output.splitlines()[-5:] == [
        "error: job #0 seed=1: walk.npy: truncated",
        "job #1 seed=2: 2",
        "error: job #2 seed=3: ValueError: a bug",
        "job #3 seed=4: 4",
        "error: 2 of 4 jobs failed",
    ]
    assert output.count("Traceback") == 1  # of the bug
    # What a job was called is told before it, its mistake where it happened.
    assert output.index("\t#0 : task=Cartpole seed=1") < output.index("error: job #0: walk.npy")


def test_a_wrong_value_fails_its_job_alone(call, jobs, capsys):
    assert call("-m", "task=Cartpole", "num_envs=0,2") == train.EXIT_FAILED_JOBS
    assert len(jobs.seeds) == 1
    assert "error: job #0 num_envs=0: num_envs: got 0, expected a whole number" in "\n".join(
        lines(capsys)
    )


def test_ctrl_c_ends_the_sweep(call, jobs, capsys, tmp_path):
    jobs.stopped_by = 2
    assert call("-m", "task=Cartpole", "seed=1,2,3") == train.EXIT_INTERRUPTED
    assert jobs.seeds == [1, 2]
    assert lines(capsys)[-1] == "warning: ended by the user: exit status 130"
    assert files(tmp_path) == SWEEP_FILES


def test_mistakes_of_a_sweep_are_one_line_and_run_nothing(call, jobs, capsys):
    for words, expected in [
        (["checkpoint=last"], "checkpoint=last with -m: each job would start from the job before"),
        (["+full_experiment_name=x"], "full_experiment_name=x with -m: all jobs would write into"),
        (["resume=last"], "-m: with resume= only settings can be given"),
        (["task=Ant,Antt"], "unknown task 'Antt'"),
        (["num_env=1,2"], "unknown key 'num_env'"),
        ([f"{CONFIG}.gamma=interval(0.9,1.0)"], "interval(...) has no list of values: add hydra/"),
    ]:
        assert call("-m", "seed=1,2", *words) == train.EXIT_USER_ERROR
        (error,) = (line for line in lines(capsys) if line.startswith("error: "))
        assert error.startswith(f"error: {expected}")
        assert jobs.seeds == []


# --- with the real runner -------------------------------------------------------------------------


@pytest.fixture
def train_here(monkeypatch, tmp_path) -> Call:
    return make_train_command(monkeypatch, tmp_path, runner.run)


def networks_of(run: Path) -> dict[str, torch.Tensor]:
    (newest,) = run.glob("nn/last_*.pth")
    return load_checkpoint(newest)["model"]


@pytest.mark.parametrize(
    "words", fast_and_slow({"ppo": CARTPOLE, "amp": ("task=HumanoidAMP", *TINY_AMP)}, "ppo")
)
def test_a_job_trains_what_a_run_of_its_own_trains(words, train_here, tmp_path):
    """The job before it leaves nothing behind, deterministic algorithms included."""
    deterministic = torch.are_deterministic_algorithms_enabled()
    assert train_here("-m", *words, "torch_deterministic=True,False", "seed=1,2") == 0
    assert torch.are_deterministic_algorithms_enabled() == deterministic
    runs = sorted(tmp_path.glob("runs/[!s]*"), key=lambda run: run.stat().st_ctime_ns)
    assert len(runs) == 4
    settings = [yaml.safe_load((run / "config.yaml").read_text()) for run in runs]
    assert [cfg["torch_deterministic"] for cfg in settings] == [True, True, False, False]
    (tmp_path / "alone").mkdir()
    alone = networks_of(train_in(tmp_path / "alone", [*words, "seed=2"]))
    assert alone.keys() == networks_of(runs[3]).keys()
    assert all(torch.equal(networks_of(runs[3])[name], alone[name]) for name in alone)
    assert any(not torch.equal(networks_of(runs[2])[name], alone[name]) for name in alone)


@pytest.mark.parametrize("measured", [True, False])
def test_a_run_returns_its_best_mean_reward(measured, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [*CARTPOLE, f"{CONFIG}.horizon_length=32", "max_iterations=6"]
    words += [f"++{CONFIG}.imitation_frequency={int(measured)}"]
    number = runner.run(compose(words))
    (run,) = tmp_path.glob("runs/*")
    log = EventAccumulator(str(run / "summaries"), {"scalars": 0})
    log.Reload()
    tag = "measured/reward" if measured else "rewards/iter"
    rewards = [event.value for event in log.Scalars(tag)]
    assert number == pytest.approx(max(rewards))
    assert len(set(rewards)) > 1
    if measured:  # the best checkpoint is the policy of the best measurement
        assert len(list(run.glob("nn/last_*"))) == 1
        return
    played = runner.run(compose([*CARTPOLE, "test=True", "checkpoint=last"]))
    assert played is not None and played > 0
    short = [f"{CONFIG}.horizon_length=2", "max_iterations=1"]  # no episode ends
    assert runner.run(compose([*words, *short])) is None


@pytest.mark.parametrize("imitation_frequency", [0, 50])
def test_a_run_of_amp_returns_its_pose_error_if_it_is_measured(
    imitation_frequency, walk_clip, tmp_path, monkeypatch, caplog
):
    """Also one that ends before the first measurement is due."""
    caplog.set_level("INFO")
    monkeypatch.chdir(tmp_path)
    words = [f"task.env.motion_file={walk_clip}", "task.env.episodeLength=6", *TINY_AMP]
    frequency = f"{CONFIG}.imitation_frequency={imitation_frequency}"
    cfg = compose(["task=HumanoidAMP", *words, frequency])
    right, wrong = ("minimize", "maximize") if imitation_frequency else ("maximize", "minimize")
    with pytest.raises(SweepError, match=f"direction={wrong}: this run of HumanoidAMP returns"):
        runner.run(cfg, direction=wrong)
    assert not list(tmp_path.glob("runs/*"))
    number = runner.run(cfg, direction=right)
    assert number is not None
    name, unit = ("best pose error", " m") if imitation_frequency else ("best mean reward", "")
    assert f"{name} {number:.4g}{unit}" in caplog.messages
    play = compose(["task=HumanoidAMP", *words, "test=True", "checkpoint=last"])
    assert 0 < (runner.run(play) or 0) < 1  # m, of a policy that stays near the clip for 6 steps


# --- with Optuna ----------------------------------------------------------------------------------


@pytest.fixture
def optuna() -> None:
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="needs the extra [sweep]")


def best(folder: Path) -> dict[str, Any]:
    (file,) = folder.glob("runs/sweep_*/optimization_results.yaml")
    return yaml.safe_load(file.read_text())


def test_a_missing_plugin_names_the_extra():
    error = MissingConfigException("missing", "hydra/sweeper/optuna", ["basic"])
    message = str(explain(error, StagedFiles(["hydra/sweeper=optuna"], Path())))
    assert message.startswith("hydra/sweeper=optuna needs packages that are not installed; pip ")
    assert message.endswith('[sweep]"')


@pytest.mark.slow
@pytest.mark.usefixtures("optuna")
def test_a_study_finds_the_best_value(call, jobs, tmp_path):
    jobs.results = {seed: -float((seed - 7) ** 2) for seed in range(11)}
    assert call("-m", *OPTUNA, "seed=choice(1,7,9)") == 0
    assert len(jobs.seeds) == 8
    assert (best(tmp_path)["best_params"], best(tmp_path)["best_value"]) == ({"seed": 7}, 0.0)
    assert jobs.directions == {"maximize"}


@pytest.mark.slow
@pytest.mark.usefixtures("optuna")
def test_failed_trials_do_not_end_a_study(call, jobs, capsys, tmp_path):
    jobs.results = {1: MotionFileError("walk.npy: truncated"), 2: None}
    assert call("-m", *OPTUNA, "seed=choice(1,2,3)") == train.EXIT_FAILED_JOBS
    assert set(jobs.seeds) == {1, 2, 3}
    assert best(tmp_path)["best_params"] == {"seed": 3}
    shown, count = lines(capsys), jobs.seeds.count
    assert sum(line.endswith("seed=1: walk.npy: truncated") for line in shown) == count(1)
    assert sum("seed=2: nothing to compare" in line for line in shown) == count(2)
    assert shown[-1] == f"error: {count(1) + count(2)} of 8 jobs failed"


@pytest.mark.slow
@pytest.mark.usefixtures("optuna")
def test_a_study_in_the_wrong_direction_ends_at_once(call, jobs, capsys):
    jobs.results = dict.fromkeys(range(3), SweepError("hydra.sweeper.direction=maximize: no"))
    assert call("-m", *OPTUNA, "seed=choice(1,2)") == train.EXIT_USER_ERROR
    assert len(jobs.seeds) == 1
    assert lines(capsys)[-1] == "error: hydra.sweeper.direction=maximize: no"


@pytest.mark.usefixtures("optuna")
def test_the_study_of_cfg_also_with_a_train_file_from_outside(call, jobs, tmp_path):
    file = tmp_path / "Mine.yaml"
    file.write_text("defaults: [HumanoidAMPPPO, _self_]\n")
    assert call("+study=disc_grad_penalty", f"train={file}", "hydra.sweeper.n_trials=2") == 0
    assert len(jobs.seeds) == 2
    assert jobs.directions == {"minimize"}
    assert 0.1 <= best(tmp_path)["best_params"][f"{CONFIG}.disc_grad_penalty"] <= 10


@pytest.mark.slow
@pytest.mark.usefixtures("optuna")
def test_a_study_by_pose_error(train_here, walk_clip, tmp_path, capsys):
    words = ["task=HumanoidAMP", f"task.env.motion_file={walk_clip}", "task.env.episodeLength=6"]
    tiny = [*words, *TINY_AMP, f"{CONFIG}.imitation_frequency=50"]
    assert train_here("+study=disc_grad_penalty", *tiny, "hydra.sweeper.n_trials=2") == 0
    shown = capsys.readouterr().err
    assert len(list(tmp_path.glob("runs/HumanoidAMP_*/nn/HumanoidAMP.pth"))) == 2
    assert f"best pose error {best(tmp_path)['best_value']:.4g} m" in shown
    # Without it the runs return rewards, which this study does not take.
    assert train_here("+study=disc_grad_penalty", *words, *TINY_AMP) == train.EXIT_USER_ERROR
    assert "returns its best mean reward" in capsys.readouterr().err
    assert len(list(tmp_path.glob("runs/HumanoidAMP_*"))) == 2


# --- in several processes -------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("program", "press"),
    [
        ([str(REPOSITORY / "train.py")], False),
        (["-m", "isaacgymenvs_lite.train"], True),
    ],
    ids=["to the end", "Ctrl-C"],
)
def test_jobs_at_the_same_time(program, press, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="needs the extra [sweep]")
    joblib = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
    epochs = 100_000 if press else 2
    words = (*CARTPOLE, *joblib, "experiment=same", f"max_iterations={epochs}")
    process = subprocess.Popen(
        [sys.executable, *program, "-m", *words, "seed=1,-2,3"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stderr is not None
    shown = list[str]()
    for line in process.stderr:
        shown.append(line)
        if press and sum("epoch 1/" in text for text in shown) == 2:
            os.killpg(process.pid, signal.SIGINT)
            press = False
    status = process.wait(60)
    output = "".join(shown)
    runs = sorted(path.name for path in tmp_path.glob("runs/same_*"))
    assert len(runs) == 2, output
    assert all(list((tmp_path / "runs" / run).glob("nn/last_*.pth")) for run in runs)
    assert "#0 epoch 1/" in output
    if epochs > 2:
        assert status == train.EXIT_INTERRUPTED
        assert "error: job #0 seed=1: ended by the user" in output
    else:
        assert status == train.EXIT_FAILED_JOBS
        assert "error: job #1 seed=-2: seed: got -2" in output
        assert "\njob #2 seed=3: " in output
