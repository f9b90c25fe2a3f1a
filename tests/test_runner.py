"""Whole runs through the composed configuration: files, resume, play, mistakes, stops."""

from __future__ import annotations

import fcntl
import logging
import os
import pty
import re
import select
import shlex
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import DictConfig, OmegaConf
from rl_games.common import env_configurations
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import isaacgymenvs_lite
from isaacgymenvs_lite.checkpoints import files as checkpoints
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.errors import (
    CheckpointError,
    ConfigError,
    NotFiniteError,
    StoppedAtOnceError,
)
from isaacgymenvs_lite.evaluation.evaluate import evaluate
from isaacgymenvs_lite.learning.common_agent import CommonAgent
from isaacgymenvs_lite.registration import register_env
from isaacgymenvs_lite.runner import load_player, run
from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP
from tests.tiny import CONFIG, ONE_THREAD, TINY_AMP, TINY_LSTM, TINY_PPO, TINY_SAC

TINY = (
    "task=HumanoidAMP",
    "task.env.episodeLength=4",
    "+train.params.torch_threads=1",
    *TINY_AMP,
)
SCALARS = {
    # CommonAgent, learning.md section 2
    "performance/total_fps",
    "performance/step_fps",
    "performance/update_time",
    "performance/play_time",
    "info/epochs",
    "losses/a_loss",
    "losses/c_loss",
    "losses/bounds_loss",
    "losses/entropy",
    "info/last_lr",
    "info/lr_mul",
    "info/e_clip",
    "info/clip_frac",
    "info/kl",
    "rewards/frame",
    "rewards/iter",
    "rewards/time",
    "episode_lengths/frame",
    "episode_lengths/iter",
    # rl_games' own
    "rewards/step",
    "shaped_rewards/step",
    "episode_lengths/step",
    "episode_lengths/time",
    "performance/step_inference_rl_update_fps",
    # AMPAgent, section 3.3
    "losses/disc_loss",
    "info/disc_agent_acc",
    "info/disc_demo_acc",
    "info/disc_agent_logit",
    "info/disc_demo_logit",
    "info/disc_grad_penalty",
    "info/disc_logit_loss",
    "info/disc_reward_mean",
    "info/disc_reward_std",
    # the imitation metric
    "imitation/pose_error_m",
    "imitation/no_fall_share",
}


def tiny(clip: Path, *overrides: str) -> DictConfig:
    return compose([*TINY, f"task.env.motion_file={clip}", *overrides])


@pytest.fixture(scope="module")
def trained_run(walk_clip, tmp_path_factory) -> Path:
    """The run folder of a training of two epochs with an imitation measurement in each."""
    folder = tmp_path_factory.mktemp("project")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run(tiny(walk_clip, f"{CONFIG}.imitation_frequency=1"))
    (run_folder,) = (folder / "runs").iterdir()
    return run_folder


@pytest.fixture
def checkpoint(trained_run) -> str:
    return str(trained_run / "nn" / "HumanoidAMP.pth")


def read_scalars(run_folder: Path) -> dict[str, list[Any]]:
    """What TensorBoard itself reads, in this process: `run` must have closed its writer."""
    accumulator = EventAccumulator(str(run_folder / "summaries"), {"scalars": 0})
    accumulator.Reload()
    return {tag: accumulator.Scalars(tag) for tag in accumulator.Tags()["scalars"]}


# --- what a training leaves behind ------------------------------------------------------------


RUN_FOLDER = {"config.yaml", "nn", "resume", "summaries"}


def test_the_run_folder(trained_run):
    # runs/<name>_<dd-HH-MM-SS>
    assert re.fullmatch(r"HumanoidAMP_\d\d-\d\d-\d\d-\d\d", trained_run.name)
    assert {path.name for path in trained_run.iterdir()} == RUN_FOLDER
    names = {path.name for path in (trained_run / "nn").iterdir()}
    assert "HumanoidAMP.pth" in names
    assert any(name.startswith("last_HumanoidAMP_ep_2_rew_") for name in names)
    for path in (trained_run / "nn").iterdir():
        assert checkpoints.load_checkpoint(path)["epoch"] == 2


def test_tensorboard_reads_all_scalars(trained_run):
    scalars = read_scalars(trained_run)
    assert set(scalars) >= SCALARS, SCALARS - set(scalars)
    for tag, events in scalars.items():
        assert all(event.value == event.value for event in events), f"{tag} is nan"
    # over frames: 16 in an epoch, written for the frames before it
    for tag in ("losses/a_loss", "losses/disc_loss", "info/kl", "performance/total_fps"):
        assert [event.step for event in scalars[tag]] == [0, 16], tag
    assert [event.value for event in scalars["info/epochs"]] == [1.0, 2.0]
    assert [event.step for event in scalars["rewards/iter"]] == [1, 2]
    # episodes end after 3 control steps of reward 1
    assert scalars["episode_lengths/frame"][-1].value == 3.0
    assert scalars["rewards/frame"][-1].value == 3.0


def test_the_configuration_of_a_run_can_be_used_again(trained_run, walk_clip, in_tmp):
    stored = OmegaConf.load(trained_run / "config.yaml")
    assert isinstance(stored, DictConfig)
    again = tiny(walk_clip, f"{CONFIG}.imitation_frequency=1")
    again.seed = 42
    assert OmegaConf.to_container(stored) == OmegaConf.to_container(again)
    check_config(stored)
    run(stored)
    (second,) = (in_tmp / "runs").iterdir()
    assert (second / "nn" / "HumanoidAMP.pth").is_file()


# --- reproducibility --------------------------------------------------------------------------


def final_model(cfg: DictConfig, folder: Path, name: str) -> dict[str, torch.Tensor]:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        OmegaConf.set_struct(cfg, False)
        cfg.full_experiment_name = name
        run(cfg)
    return checkpoints.load_checkpoint(folder / "runs" / name / "nn" / "HumanoidAMP.pth")["model"]


def equal(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(first[name], second[name]) for name in first)


def test_the_same_seed_gives_the_same_model(tmp_path, walk_clip):
    models = [final_model(tiny(walk_clip, "seed=7"), tmp_path, name) for name in ("a", "b")]
    assert equal(*models)
    assert not equal(models[0], final_model(tiny(walk_clip, "seed=8"), tmp_path, "c"))


def test_measuring_imitation_does_not_change_the_training(tmp_path, walk_clip, caplog):
    measured = tiny(walk_clip, "max_iterations=3", f"{CONFIG}.imitation_frequency=1")
    with caplog.at_level(logging.INFO):
        model = final_model(measured, tmp_path, "a")
    assert "pose error" in caplog.text
    plain = tiny(walk_clip, "max_iterations=3")
    assert equal(model, final_model(plain, tmp_path, "b"))


# --- resume and play --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "asked",
    [
        ("checkpoint={}",),
        ("train.params.load_checkpoint=True", "train.params.load_path={}"),  # by the train file
    ],
)
def test_training_goes_on_from_a_checkpoint(in_tmp, walk_clip, checkpoint, asked):
    run(tiny(walk_clip, *(key.format(checkpoint) for key in asked), "max_iterations=3"))
    (folder,) = (in_tmp / "runs").iterdir()
    loaded = checkpoints.load_checkpoint(folder / "nn" / "HumanoidAMP.pth")
    assert loaded["epoch"] == 3
    assert loaded["frame"] == 48  # two epochs of 16 before, one now


def test_a_run_in_a_folder_of_its_own(in_tmp, walk_clip, caplog, capsys):
    run(tiny(walk_clip, "max_iterations=1", "experiment=amp/walk1"))
    (folder,) = (in_tmp / "runs" / "amp").iterdir()
    assert re.fullmatch(r"walk1(_\d\d){1}(-\d\d){3}", folder.name)
    assert {path.name for path in folder.iterdir()} == RUN_FOLDER
    names = {path.name for path in (folder / "nn").iterdir()}
    assert "walk1.pth" in names
    assert any(name.startswith("last_walk1_ep_1_rew_") for name in names)
    assert list(folder.glob("summaries/events.*"))
    # It is played and goes on from there.
    games = f"+{CONFIG}.player.games_num=4"
    with caplog.at_level(logging.INFO):
        run(tiny(walk_clip, "test=True", "checkpoint=last", games))
    assert "played 4 episodes" in caplog.text
    exact = "+full_experiment_name=amp/more/walk2"
    run(tiny(walk_clip, "checkpoint=last", exact, "experiment=amp/walk1"))
    loaded = checkpoints.load_checkpoint(in_tmp / "runs/amp/more/walk2/nn/walk1.pth")
    assert loaded["epoch"] == 2
    assert {path.name for path in in_tmp.iterdir()} == {"runs"}
    assert capsys.readouterr().out == ""
    with pytest.raises(ConfigError, match=r"lies in the folder of another run, .*walk2"):
        run(tiny(walk_clip, "+full_experiment_name=amp/more/walk2/nn"))


def test_no_run_leaves_the_folder_of_the_runs(in_tmp, walk_clip):
    for name in ["experiment=../../x", "+full_experiment_name=../x", f"{CONFIG}.name=/x"]:
        with pytest.raises(ConfigError, match="leads out of the folder of the runs"):
            run(tiny(walk_clip, name))
        assert list(in_tmp.iterdir()) == []


def test_a_play_reports_and_writes_nothing(in_tmp, walk_clip, checkpoint, caplog):
    with caplog.at_level(logging.INFO):
        run(
            tiny(
                walk_clip, "test=True", f"checkpoint={checkpoint}", f"+{CONFIG}.player.games_num=8"
            )
        )
    (line,) = [message for message in caplog.messages if message.startswith("played ")]
    for words in ("8 episodes", "reward", "episode length", "style reward", "pose error"):
        assert words in line
    assert f"checkpoint: {checkpoint}" in caplog.messages
    assert list(in_tmp.iterdir()) == []


def test_sigma_replaces_the_log_standard_deviation(in_tmp, walk_clip, checkpoint):
    run(tiny(walk_clip, f"checkpoint={checkpoint}", "max_iterations=3", "sigma=-1.5"))
    (folder,) = (in_tmp / "runs").iterdir()
    model = checkpoints.load_checkpoint(folder / "nn" / "HumanoidAMP.pth")["model"]
    assert model["a2c_network.sigma"].tolist() == pytest.approx([-1.5] * 28)
    with load_player(tiny(walk_clip, f"checkpoint={checkpoint}", "sigma=-0.5")) as player:
        assert player.model.a2c_network.sigma.tolist() == pytest.approx([-0.5] * 28)


def test_a_task_that_a_user_registered_stays_registered(in_tmp, walk_clip, monkeypatch):
    """The runner passes its task to rl_games without the registry of the process."""
    known = env_configurations.configurations
    monkeypatch.setitem(known, "rlgpu", {})  # put back afterwards
    own: Any = lambda **_: pytest.fail("the task of the user was made")  # noqa: E731
    register_env(own)
    run(tiny(walk_clip, "max_iterations=1"))
    run(tiny(walk_clip, "test=True", "checkpoint=last", f"+{CONFIG}.player.games_num=4"))
    assert known["rlgpu"]["env_creator"] is own


# --- mistakes of users ------------------------------------------------------------------------


@pytest.fixture
def no_training(monkeypatch) -> None:
    """Fails the test if an epoch begins."""
    monkeypatch.setattr(CommonAgent, "play_steps", lambda self: pytest.fail("an epoch began"))


def one_line(error: Exception) -> str:
    assert "\n" not in str(error)
    return str(error)


@pytest.mark.usefixtures("no_training")
def test_a_checkpoint_of_another_network_is_refused(in_tmp, walk_clip, checkpoint):
    for test in [False, True]:
        cfg = tiny(
            walk_clip,
            f"test={test}",
            f"checkpoint={checkpoint}",
            "train.params.network.mlp.units=[32,8]",
        )
        with pytest.raises(CheckpointError) as caught:
            run(cfg)
        message = one_line(caught.value)
        for words in (checkpoint, "another network", "actor_mlp", "config.yaml"):
            assert words in message


@pytest.mark.usefixtures("no_training")
def test_a_missing_checkpoint_is_refused(in_tmp, walk_clip):
    with pytest.raises(CheckpointError, match=r"checkpoint=nn/none\.pth"):
        run(tiny(walk_clip, "checkpoint=nn/none.pth"))
    with pytest.raises(CheckpointError, match="checkpoint=last"):
        run(tiny(walk_clip, "checkpoint=last"))
    assert list(in_tmp.iterdir()) == []


@pytest.mark.usefixtures("no_training")
def test_a_run_folder_that_cannot_be_written_is_refused(in_tmp, walk_clip):
    (in_tmp / "taken").write_text("a file")
    with pytest.raises(ConfigError, match=r"cannot write the run folder .*taken") as caught:
        run(tiny(walk_clip, f"+{CONFIG}.train_dir=taken/runs"))
    assert "train_dir" in one_line(caught.value)


@pytest.mark.usefixtures("no_training")
def test_a_mistake_leaves_nothing_of_its_run_behind(in_tmp, walk_clip):
    for setting in ["disc_loss=wgan", "imitation_frequency=-1"]:
        with pytest.raises(ConfigError, match=setting.partition("=")[0]):
            run(tiny(walk_clip, f"{CONFIG}.{setting}"))
        assert [path for path in in_tmp.rglob("*") if path.is_file()] == []


@pytest.mark.usefixtures("no_training")
@pytest.mark.parametrize("name", ["results", "amp/results"])
def test_a_mistake_does_not_touch_what_was_there_before(name, in_tmp, walk_clip):
    """+full_experiment_name= may name a folder that has files of the user in it."""
    kept = in_tmp / "runs" / name / "summaries" / "earlier"
    kept.parent.mkdir(parents=True)
    kept.write_text("precious")
    with pytest.raises(ConfigError, match="disc_loss"):
        run(tiny(walk_clip, f"{CONFIG}.disc_loss=wgan", f"+full_experiment_name={name}"))
    assert kept.is_file()
    assert kept.read_text() == "precious"


@pytest.mark.usefixtures("no_training")
def test_a_wrong_name_or_value_is_refused(in_tmp, walk_clip):
    for override, words in [
        ("train.params.algo.name=amp_agnet", ["amp_agnet", "amp_agent"]),
        ("train.params.model.name=continuous", ["continuous", "continuous_amp"]),
        ("train.params.network.name=ampp", ["ampp", "amp"]),
        (f"{CONFIG}.imitation_frequency=-1", ["imitation_frequency", "-1"]),
        (f"{CONFIG}.imitation_frequency=often", ["imitation_frequency", "often"]),
        (f"{CONFIG}.disc_loss=wgan", ["disc_loss", "wgan", "bce"]),
        (f"{CONFIG}.mixed_precision=bf16", ["mixed_precision", "bf16", "auto"]),
    ]:
        with pytest.raises(ConfigError) as caught:
            run(tiny(walk_clip, override))
        message = one_line(caught.value)
        assert all(word in message for word in words), message


def test_a_task_that_gives_nan_ends_the_run_and_keeps_its_folder(in_tmp, walk_clip, monkeypatch):
    step = HumanoidAMP.step

    def broken(self: HumanoidAMP, actions: torch.Tensor) -> Any:
        obs, rewards, dones, infos = step(self, actions)
        if self.control_steps == 6:
            rewards[1] = torch.nan
        return obs, rewards, dones, infos

    monkeypatch.setattr(HumanoidAMP, "step", broken)
    with pytest.raises(NotFiniteError, match=r"rewards of environment 1 hold nan at step 1 of epo"):
        run(tiny(walk_clip, "max_iterations=5"))
    (folder,) = (in_tmp / "runs").iterdir()
    (saved,) = (folder / "nn").iterdir()
    assert saved.name == "HumanoidAMP_interrupted.pth"
    monkeypatch.undo()
    monkeypatch.chdir(in_tmp)
    run(tiny(walk_clip, "test=True", "checkpoint=last", f"+{CONFIG}.player.games_num=4"))


# --- simulations are freed --------------------------------------------------------------------


@pytest.fixture
def tasks(monkeypatch) -> dict[str, list[HumanoidAMP]]:
    """Which tasks were made and which were closed."""
    seen: dict[str, list[HumanoidAMP]] = {"made": [], "closed": []}
    init, close = HumanoidAMP.__init__, HumanoidAMP.close

    def counted_init(self: HumanoidAMP, *args: Any, **kwargs: Any) -> None:
        init(self, *args, **kwargs)
        seen["made"].append(self)

    def counted_close(self: HumanoidAMP) -> None:
        close(self)
        seen["closed"].append(self)

    monkeypatch.setattr(HumanoidAMP, "__init__", counted_init)
    monkeypatch.setattr(HumanoidAMP, "close", counted_close)
    return seen


def all_closed(tasks: dict[str, list[HumanoidAMP]]) -> bool:
    return {id(task) for task in tasks["made"]} == {id(task) for task in tasks["closed"]}


def test_a_training_and_its_measurements_free_their_simulations(in_tmp, walk_clip, tasks):
    run(tiny(walk_clip, f"{CONFIG}.imitation_frequency=1"))
    assert [task.num_envs for task in tasks["made"]] == [4, 16]
    assert all_closed(tasks)


def test_a_refused_run_frees_its_simulation(in_tmp, walk_clip, tasks):
    for override in [
        "train.params.algo.name=nobody",
        f"+{CONFIG}.train_dir=taken/x",
        f"{CONFIG}.disc_loss=wgan",
    ]:
        (in_tmp / "taken").write_text("a file")
        with pytest.raises(ConfigError):
            run(tiny(walk_clip, override))
        assert all_closed(tasks)


def test_a_loaded_player_frees_its_simulation_after_an_error(in_tmp, walk_clip, checkpoint, tasks):
    threads = torch.get_num_threads()
    cfg = tiny(walk_clip, f"checkpoint={checkpoint}", "train.params.torch_threads=3")
    with pytest.raises(ArithmeticError), load_player(cfg) as player:
        assert player.env is tasks["made"][-1]
        assert player.act(player.env.reset()).shape == (4, 28)
        raise ArithmeticError
    assert len(tasks["made"]) == 1
    assert all_closed(tasks)
    assert torch.get_num_threads() == threads
    assert list(in_tmp.iterdir()) == []


# --- stopping and failing ---------------------------------------------------------------------


@pytest.fixture
def in_epoch(monkeypatch) -> Callable[[int, Callable[[], None]], None]:
    """Return a function (n, act) that lets `act` happen in the middle of epoch n."""

    def arrange(number: int, act: Callable[[], None]) -> None:
        prepare_dataset = CommonAgent.prepare_dataset

        def prepare(self: Any, batch: Any) -> None:
            if self.epoch_num == number:
                act()
            prepare_dataset(self, batch)

        monkeypatch.setattr(CommonAgent, "prepare_dataset", prepare)

    return arrange


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_one_signal_finishes_the_epoch_and_saves(number, in_tmp, walk_clip, in_epoch):
    in_epoch(3, lambda: os.kill(os.getpid(), number))
    run(tiny(walk_clip, "max_iterations=20"))
    (folder,) = (in_tmp / "runs").iterdir()
    (last,) = (folder / "nn").glob("last_HumanoidAMP_ep_3_*.pth")
    assert checkpoints.load_checkpoint(last)["epoch"] == 3


def test_two_signals_end_at_once_with_a_checkpoint(in_tmp, walk_clip, in_epoch, caplog):
    def twice() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        threading.Event().wait(1.0)  # the handler runs here at the latest

    in_epoch(2, twice)
    with pytest.raises(StoppedAtOnceError) as caught:
        run(tiny(walk_clip, "max_iterations=20"))
    assert caught.value.exit_status == 128 + signal.SIGTERM
    (folder,) = (in_tmp / "runs").iterdir()
    saved = checkpoints.load_checkpoint(folder / "nn" / "HumanoidAMP_interrupted.pth")
    assert saved["epoch"] == 2
    assert "stopped at once" in caplog.text


def test_a_full_disk_does_not_end_the_training(in_tmp, walk_clip, monkeypatch, caplog):
    rescue = in_tmp / "system_tmp"
    rescue.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(rescue))
    real_save = torch.save

    def save(obj: Any, file: Any) -> None:
        if "system_tmp" not in str(file.name):
            raise OSError(28, "No space left on device")
        real_save(obj, file)

    monkeypatch.setattr(torch, "save", save)
    with caplog.at_level(logging.INFO):
        run(tiny(walk_clip))
    (folder,) = (in_tmp / "runs").iterdir()
    assert list((folder / "nn").iterdir()) == []
    rescued = list(rescue.rglob("*.pth"))
    assert rescued
    assert checkpoints.load_checkpoint(rescued[0])["epoch"] == 2
    assert "No space left on device" in caplog.text
    (closing,) = [message for message in caplog.messages if "; play it: " in message]
    assert closing.startswith(f"saved {rescue}")
    # What the closing line says finds the file.
    with caplog.at_level(logging.INFO):
        run(tiny(walk_clip, "test=True", "checkpoint=last", f"+{CONFIG}.player.games_num=4"))
    assert "checkpoint=last uses the rescued checkpoint" in caplog.text
    assert "played 4 episodes" in caplog.text


def test_a_run_that_can_save_nothing_is_a_mistake(in_tmp, walk_clip, monkeypatch):
    def fail(obj: Any, file: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.tempdir", str(in_tmp))
    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(CheckpointError, match=r"this training has no checkpoint.*train_dir="):
        run(tiny(walk_clip, "max_iterations=1"))
    (folder,) = (in_tmp / "runs").iterdir()
    assert list(folder.glob("summaries/events.*"))  # the curve stays


def test_the_newest_checkpoints_stay_and_what_was_there_before(in_tmp):
    """keep_checkpoints removes own files only."""
    earlier = in_tmp / "runs" / "mine" / "nn" / "last_Cartpole_ep_1_rew_9.pth"
    earlier.parent.mkdir(parents=True)
    earlier.write_bytes(b"earlier")
    settings = ("save_frequency=1", "save_best_after=1", "keep_checkpoints=2")
    words = ["task=Cartpole", *TINY_PPO, *(f"++{CONFIG}.{setting}" for setting in settings)]
    run(compose([*words, "max_iterations=6", "+full_experiment_name=mine"]))
    assert earlier.read_bytes() == b"earlier"
    names = {path.name for path in earlier.parent.iterdir()} - {earlier.name}
    assert "Cartpole.pth" in names
    epochs = [re.search(r"_ep_(\d+)_", name) for name in names]
    assert sorted(found[1] for found in epochs if found) == ["5", "6"]  # one file an epoch


@pytest.mark.parametrize("algorithm", ["ppo", "lstm", "sac"])
def test_the_best_checkpoint_earns_what_was_measured(algorithm, in_tmp, caplog):
    words = {
        "ppo": ["task=Cartpole", *TINY_PPO, "max_iterations=4"],
        "lstm": [*TINY_LSTM, *ONE_THREAD],
        "sac": [*TINY_SAC, *ONE_THREAD, "max_iterations=6", "task.env.episodeLength=30"],
    }[algorithm]
    words.append(f"++{CONFIG}.imitation_frequency=1")
    with caplog.at_level("INFO"):
        best = run(compose(words))
    (played,) = re.findall(r"checkpoint=(\S+\.pth|last)", caplog.text)[-1:]
    play = ["test=True", f"checkpoint={played}", "num_envs=16"]
    with load_player(compose([*words, *play])) as player:
        torch.manual_seed(1234)  # as measurements
        result = evaluate(player.env, player.act, 16, on_step=player.on_step)
    # The contacts of Ant depend on what its simulation did before.
    assert result.reward == pytest.approx(best, rel=0.1 if algorithm == "sac" else 1e-3)
    assert f"best mean reward {best:.4g} after epoch" in caplog.text


def start_training(clip: Path, *before: str, **kwargs: Any) -> subprocess.Popen[str]:
    """A process of its own that trains until somebody ends it."""
    command = [*before, sys.executable, "-m", "isaacgymenvs_lite.train", *TINY]
    arguments = [f"task.env.motion_file={clip}", "max_iterations=100000"]
    repository = str(Path(isaacgymenvs_lite.__file__).parents[1])
    env = {**os.environ, "PYTHONPATH": repository}
    return subprocess.Popen([*command, *arguments], env=env, text=True, **kwargs)


def wait_for(condition: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 120
    while not condition():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.mark.slow
def test_a_terminal_that_closes_ends_the_training_with_a_checkpoint(in_tmp, walk_clip):
    """As an ssh session that breaks: SIGHUP, and nothing more can be shown."""
    master, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 0, 0))
    shown = bytearray()

    def take_terminal() -> None:
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    process = start_training(
        walk_clip,
        **dict.fromkeys(("stdin", "stdout", "stderr"), terminal),
        start_new_session=True,
        preexec_fn=take_terminal,
    )
    try:
        os.close(terminal)

        def has_progress() -> bool:
            readable, _, _ = select.select([master], [], [], 0.0)
            if readable:
                shown.extend(os.read(master, 4096))
            return b"%|" in shown

        wait_for(has_progress, process)
        os.close(master)
        assert process.wait(timeout=120) == 0
    finally:
        process.kill()
    (folder,) = (in_tmp / "runs").iterdir()
    (last,) = (folder / "nn").glob("last_HumanoidAMP_ep_*.pth")
    assert f"_ep_{checkpoints.load_checkpoint(last)['epoch']}_" in last.name


@pytest.mark.slow
def test_ctrl_c_on_the_command_line(in_tmp, walk_clip):
    """A process of its own: SIGINT after the first line of progress, exit code 0."""
    process = start_training(walk_clip, stderr=subprocess.PIPE)
    try:
        assert process.stderr is not None
        shown = ""
        for line in process.stderr:
            shown += line
            if line.startswith("epoch "):
                break
        process.send_signal(signal.SIGINT)
        _, rest = process.communicate(timeout=120)
    finally:
        process.kill()
    assert "\nepoch " in f"\n{shown}", shown
    assert process.returncode == 0, rest
    assert "Traceback" not in rest
    (folder,) = (in_tmp / "runs").iterdir()
    (last,) = (folder / "nn").glob("last_HumanoidAMP_ep_*.pth")
    epoch = checkpoints.load_checkpoint(last)["epoch"]
    assert f"_ep_{epoch}_" in last.name
    assert epoch < 100000
    # What the line says goes on where this one ended.
    (going_on,) = re.findall(r"^go on with it: (.*)$", rest, re.MULTILINE)
    assert shlex.split(going_on)[-1] == f"resume=runs/{folder.name}"
    assert f"\nepoch {epoch}/100000, " in f"\n{shown}{rest}"
