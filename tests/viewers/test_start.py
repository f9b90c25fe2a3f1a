"""Videos by the command line's settings: of every kind of agent, in training and in play."""

from __future__ import annotations

import dataclasses

import pytest
from omegaconf import DictConfig

from isaacgymenvs_lite import registration, runner
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.gl import RenderingError
from isaacgymenvs_lite.runner import run
from isaacgymenvs_lite.viewers import start
from tests.tiny import CONFIG, NOT_MEASURED, ONE_THREAD, TINY_AMP, TINY_SAC
from tests.viewers.conftest import assert_is_a_video, frames_of

VIDEOS = ("capture_video=True", "capture_video_freq=20", "capture_video_len=6")
SIZE = ("num_envs=4", *ONE_THREAD, "+train.params.torch_threads=1")
AMP = ("task=HumanoidAMP", *TINY_AMP)
PPO = ("task=Cartpole", "max_iterations=2", f"{CONFIG}.horizon_length=4", NOT_MEASURED)
SAC = (*TINY_SAC, "max_iterations=6")
HRL = (
    *("task=HumanoidASE", "train=HumanoidASEHRLPPO", "max_iterations=1"),
    *(f"{CONFIG}.horizon_length=2", f"{CONFIG}.mini_epochs=1"),
)

pytestmark = pytest.mark.usefixtures("gl", "small_pictures")


@pytest.fixture
def no_training(monkeypatch) -> None:
    """Fail when an agent is made."""

    def refuse(*_: object) -> None:
        raise AssertionError("a training began")

    monkeypatch.setattr(registration, "build_runner", refuse)


def cfg_of(*overrides: str) -> DictConfig:
    return compose([*SIZE, *overrides])


@pytest.mark.parametrize("agent", [SAC, AMP, HRL], ids=["sac", "amp", "hrl"])
def test_a_training_is_recorded(agent, in_tmp):
    run(cfg_of(*agent, *VIDEOS))
    (run_folder,) = (in_tmp / "runs").iterdir()
    first = run_folder / "videos" / "rl-video-step-0.mp4"
    assert_is_a_video(frames_of(first)[0], 6)


def test_a_play_is_recorded_into_the_run_of_its_checkpoint(in_tmp):
    run(cfg_of(*PPO))
    (checkpoint,) = in_tmp.glob("runs/*/nn/Cartpole.pth")
    play = (
        "task=Cartpole",
        "test=True",
        f"checkpoint={checkpoint}",
        f"+{CONFIG}.player.games_num=4",
    )
    run(cfg_of(*play, *VIDEOS))
    first, *_ = sorted((checkpoint.parent.parent / "videos").iterdir())
    assert first.name.startswith("play_")
    assert_is_a_video(frames_of(first)[0], 6)
    assert len(list((in_tmp / "runs").iterdir())) == 1


def test_videos_do_not_go_through_a_link_in_the_run_of_a_checkpoint(in_tmp):
    run(cfg_of(*PPO))
    (checkpoint,) = in_tmp.glob("runs/*/nn/Cartpole.pth")
    (checkpoint.parents[1] / "videos").symlink_to(in_tmp)
    with pytest.raises(ConfigError, match="/videos is a link, "):
        run(cfg_of("task=Cartpole", "test=True", f"checkpoint={checkpoint}", *VIDEOS))


@pytest.mark.usefixtures("no_training")
def test_a_machine_that_cannot_draw_is_found_before_the_task_is_made(in_tmp, monkeypatch):
    def fail() -> str:
        raise RenderingError("apt-get install libegl1")

    monkeypatch.setattr(start, "ensure_gl", fail)
    monkeypatch.setattr(runner, "make_from_config", lambda *_, **__: pytest.fail("a task"))
    with pytest.raises(RenderingError):
        run(cfg_of(*PPO, *VIDEOS))
    assert not list(in_tmp.iterdir())


class ClosedWindow:
    """A window that somebody closes after three steps."""

    def __init__(self, env, folder, on_quit, *, every_step: bool, keys_to_task: bool) -> None:
        del env, folder, keys_to_task
        self._on_quit = on_quit
        self.steps = 0
        assert every_step  # force_render, as published

    def after_step(self) -> None:
        self.steps += 1
        if self.steps == 3:
            self._on_quit()

    def render(self) -> None:
        pass

    def close(self) -> None:
        pass


class OpenWindow(ClosedWindow):
    """A window in which somebody watches 700 steps, and who then closes it or presses Ctrl-C."""

    keeps_playing = True

    def after_step(self) -> None:
        self.steps += 1
        if self.steps == 700:
            self.end()

    def end(self) -> None:
        self._on_quit()


class InterruptedWindow(OpenWindow):
    def end(self) -> None:
        raise KeyboardInterrupt


@pytest.fixture
def closed_window(monkeypatch) -> None:
    monkeypatch.setattr(start, "check_display", lambda: None)
    monkeypatch.setattr(start, "Window", ClosedWindow)


@pytest.mark.usefixtures("closed_window")
def test_a_training_ends_with_its_window_after_the_epoch(in_tmp, caplog):
    run(cfg_of(*PPO, "max_iterations=50", "headless=False"))
    assert list(in_tmp.glob("runs/*/nn/Cartpole.pth"))
    assert "ending after this epoch with a checkpoint" in caplog.text


@pytest.mark.usefixtures("closed_window")
def test_a_play_ends_with_its_window_at_once(in_tmp, caplog):
    run(cfg_of("task=Cartpole", "test=True", "headless=False"))
    assert "episodes" not in caplog.text


@pytest.mark.parametrize("window", [OpenWindow, InterruptedWindow])
def test_a_play_goes_on_after_its_episodes_until_somebody_ends_it(
    window, in_tmp, monkeypatch, caplog
):
    windows = []

    def open_window(*args, **options):
        windows.append(window(*args, **options))
        return windows[0]

    monkeypatch.setattr(start, "check_display", lambda: None)
    monkeypatch.setattr(start, "Window", open_window)
    play = ("task=Cartpole", "test=True", f"+{CONFIG}.player.games_num=4", "headless=False")
    with caplog.at_level("INFO"):
        run(cfg_of(*play))
    messages = [record.message.partition(" ")[0] for record in caplog.records]
    assert messages.index("played") < messages.index("playing")
    assert windows[0].steps == 700


@pytest.mark.usefixtures("no_training")
def test_without_a_display_no_task_is_made(in_tmp, monkeypatch):
    def refuse() -> None:
        raise ConfigError("no display")

    monkeypatch.setattr(start, "check_display", refuse)
    monkeypatch.setattr(runner, "make_from_config", lambda *_, **__: pytest.fail("a task"))
    with pytest.raises(ConfigError, match="no display"):
        run(cfg_of(*PPO, "headless=False"))


class NoPage:
    def close(self) -> None:
        """Close nothing."""


@pytest.mark.parametrize("plays", [True, False])
def test_a_play_says_what_the_keys_do(plays: bool, make_env, tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO")
    monkeypatch.setattr(start, "check_page", lambda *_: None)
    monkeypatch.setattr(start, "WebPage", lambda *_, **__: NoPage())
    settings = check_config(cfg_of("task=RobotAMPVelocity", "viewer=web"))
    env = make_env("task=RobotAMPVelocity", "num_envs=1")
    with start.Viewers(dataclasses.replace(settings, test=plays)) as viewers:
        viewers.start(env, tmp_path, lambda: None)
    assert ("keys in the viewer: up, down: faster, slower" in caplog.text) is plays
