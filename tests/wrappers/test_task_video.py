"""Videos that begin at chosen steps and episodes, read back."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from isaacgymenvs_lite.wrappers.task_video import TaskVideo
from tests.viewers.conftest import assert_is_a_video, frames_of
from tests.wrappers.conftest import MakeTask

pytestmark = pytest.mark.usefixtures("gl")


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch) -> None:
    monkeypatch.setattr("isaacgymenvs_lite.viewers.videos.SINGLE_SIZE", (64, 48))


def _lengths(folder: Path) -> dict[str, int]:
    return {path.stem: len(frames_of(path)[0]) for path in folder.iterdir()}


def _play(recorded: TaskVideo, num_steps: int) -> None:
    recorded.reset()
    for _ in range(num_steps):
        recorded.step(torch.ones(recorded.num_envs, recorded.num_actions))
    recorded.close_video_recorder()


def test_steps_as_in_the_published_readme(make_cartpole: MakeTask, tmp_path: Path) -> None:
    env = make_cartpole()
    env.is_vector_env = True
    recorded = TaskVideo(
        env, str(tmp_path / "videos"), step_trigger=lambda step: step % 10 == 0, video_length=8
    )
    _play(recorded, 12)
    # The second one was cut short by the end.
    assert _lengths(tmp_path / "videos") == {"rl-video-step-0": 8, "rl-video-step-10": 2}
    assert_is_a_video(frames_of(tmp_path / "videos" / "rl-video-step-0.mp4")[0], 8)


def test_episodes_of_environment_0(make_cartpole: MakeTask, tmp_path: Path) -> None:
    recorded = TaskVideo(
        make_cartpole("task.env.resetDist=100"),
        tmp_path,
        episode_trigger=lambda episode: episode % 2 == 0,
        name_prefix="pole",
    )
    recorded.reset()
    ended = [bool(recorded.step(torch.ones(6, 1))[2][0]) for _ in range(60)]
    recorded.close_video_recorder()
    ends = [step for step, end in enumerate(ended, start=1) if end]
    assert len(ends) >= 2
    lengths = _lengths(tmp_path)
    assert lengths["pole-episode-0"] == ends[0]
    assert "pole-episode-1" not in lengths
    assert lengths["pole-episode-2"] == (ends[2] if len(ends) > 2 else 60) - ends[1]


def test_everything_else_is_the_task_s(make_cartpole: MakeTask, tmp_path: Path) -> None:
    env = make_cartpole()
    recorded = TaskVideo(env, tmp_path, step_trigger=lambda step: False)
    assert recorded.unwrapped is env
    assert (recorded.num_envs, recorded.observation_space) == (6, env.observation_space)
    assert recorded.reset()["obs"].shape == (6, 4)
    assert recorded.reset_done()[1].tolist() == []
    assert recorded.render(mode="human") is None
    with pytest.raises(AttributeError):
        _ = recorded.no_such_thing
    recorded.close()
    assert list(tmp_path.iterdir()) == []
