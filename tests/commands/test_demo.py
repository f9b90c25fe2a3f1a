"""The demo with a tiny policy in place of the shipped ones."""

from __future__ import annotations

import io
import logging
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import PIL.Image
import pytest

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.checkpoints.packed import pack_policy
from isaacgymenvs_lite.commands import demo
from isaacgymenvs_lite.commands.demo import DemoSettings, run_demo
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.errors import ConfigError, MotionFileError
from isaacgymenvs_lite.motion.formats import deepmimic
from isaacgymenvs_lite.runner import run
from tests.tiny import CONFIG, TINY_AMP, TINY_PPO, train_in

TINY = (*TINY_AMP, "max_iterations=1")


@pytest.fixture(scope="module")
def assets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of assets with two policies of one epoch."""
    folder = tmp_path_factory.mktemp("project")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run(compose(TINY))
    (checkpoint,) = folder.glob("runs/*/nn/HumanoidAMP.pth")
    for name in ("tiny", "small"):
        pack_policy(checkpoint, name, folder=folder / "assets" / "policies")
    return folder / "assets"


@pytest.fixture
def policies(assets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paths, "shipped_policies_dir", lambda: assets / "policies")


@pytest.fixture
def small_panels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "_SIZES", {"mp4": (48, 64, 1), "webp": (48, 64, 2)})


@pytest.mark.usefixtures("policies", "gl", "small_panels")
def test_every_shipped_policy_is_played_measured_and_filmed(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    with caplog.at_level(logging.INFO):
        assert demo.main(["seconds=0.3"]) == 0
    for name in ("small", "tiny"):
        path = tmp_path / "demo" / f"{name}.mp4"
        with av.open(str(path)) as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert len(frames) == 9  # 0.3 s of control steps of 0.0332 s
        assert frames[0].shape == (64, 96, 3)
        assert min(frame.mean() for frame in frames) > 100
        assert np.abs(frames[8].astype(int) - frames[0]).max() > 60
        assert f"{name}: 16 episodes: pose error 0." in caplog.text
        assert f"{name}: wrote demo/{name}.mp4" in caplog.text
    assert "without a fall" in caplog.text
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("policies", "gl")
def test_a_picture_shows_the_clip_above_the_policy(tmp_path):
    settings = DemoSettings(policies=("tiny",), seconds=0.3, format="png", out=str(tmp_path))
    run_demo(settings)
    with PIL.Image.open(tmp_path / "tiny.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert pixels.shape == (2 * 320, 8 * 200, 3)
    # both begin in the same phase
    beginning = np.abs(pixels[:320, :200] - pixels[320:, :200])
    assert (beginning > 60).mean() < 0.1


@pytest.fixture
def pack_skills(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Return `pack_skills(task)`, which trains skills for an epoch and ships them as `skills`."""

    def pack(task: str) -> None:
        monkeypatch.chdir(tmp_path)
        # Of some steps of the warm start, so that latents differ. It observes its demonstration in
        # as many rows as there are environments.
        words = [
            *TINY,
            "num_envs=64",
            "train.params.network.style.units=[8]",
            f"{CONFIG}.warm_start_steps=100",
        ]
        run(compose([f"task={task}", "task.env.motion_file=stand", *words]))
        (checkpoint,) = tmp_path.glob(f"runs/*/nn/{task}.pth")
        pack_policy(checkpoint, "skills", folder=tmp_path / "assets" / "policies")
        monkeypatch.setattr(paths, "shipped_policies_dir", lambda: tmp_path / "assets" / "policies")

    return pack


@pytest.mark.slow
@pytest.mark.usefixtures("gl", "small_panels")
def test_skills_are_shown_in_several_environments(pack_skills, tmp_path):
    pack_skills("HumanoidASE")
    performance = demo.perform("skills", 0.3)
    assert [track.shape for track in performance.tracks] == [(9, 43)] * 3
    first, second, _ = performance.tracks
    np.testing.assert_allclose(first[0, 7:], second[0, 7:], atol=0.3)  # one step from default
    assert np.abs(first[8] - second[8]).max() > 1e-3  # other latents
    assert "pose error" not in performance.summary
    assert "without a fall" in performance.summary
    path = demo.save_performance(performance, tmp_path / "skills.webp")
    with PIL.Image.open(path) as image:
        assert image.size == (3 * 48, 64)


class Terminal(io.StringIO):
    """Standard input that a user types into."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("answer", "names"),
    [
        ("\n", ["small", "tiny"]),
        ("2\n", ["tiny"]),
        ("tiny, 1\n", ["tiny", "small"]),
        ("", ["small", "tiny"]),  # the end of the input
    ],
)
@pytest.mark.usefixtures("policies", "gl", "small_panels")
def test_a_terminal_is_asked_which_policies_to_show(answer, names, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdin", Terminal(answer))
    files = run_demo(DemoSettings(out=str(tmp_path), seconds=0.1))
    assert files == [tmp_path / f"{name}.mp4" for name in names]
    choice = capsys.readouterr().out.splitlines()
    assert choice[0].startswith("   1  small ") and choice[1].startswith("   2  tiny ")
    assert "HumanoidAMP of walk.npz" in choice[0]


@pytest.mark.usefixtures("gl", "small_panels")
def test_all_leaves_out_a_policy_whose_clip_is_not_installed(assets, tmp_path, monkeypatch, caplog):
    (checkpoint,) = assets.parent.glob("runs/*/nn/HumanoidAMP.pth")
    for name, clip in (("flip", "deepmimic:backflip"), ("walk", "walk")):
        pack_policy(checkpoint, name, clip, folder=tmp_path / "assets" / "policies")
    monkeypatch.setattr(paths, "shipped_policies_dir", lambda: tmp_path / "assets" / "policies")
    monkeypatch.setattr(deepmimic, "_PACKAGE", "no_such_package")
    with caplog.at_level(logging.INFO):
        assert run_demo(DemoSettings(out=str(tmp_path), seconds=0.1)) == [tmp_path / "walk.mp4"]
    assert "flip is left out: 'deepmimic:backflip' belongs to the package" in caplog.text
    assert "isaacgymenvs-lite[motions]" in caplog.text
    with pytest.raises(MotionFileError, match="is not installed"):
        run_demo(DemoSettings(policies=("flip",), out=str(tmp_path)))


@pytest.mark.usefixtures("gl", "small_panels")
def test_a_classic_task_is_shown_in_three_environments(tmp_path, monkeypatch, caplog):
    run_folder = train_in(tmp_path, ["task=Cartpole", *TINY_PPO, "max_iterations=1"])
    pack_policy(run_folder / "nn" / "Cartpole.pth", "pole", folder=tmp_path / "assets/policies")
    monkeypatch.setattr(paths, "shipped_policies_dir", lambda: tmp_path / "assets" / "policies")
    performance = demo.perform("pole", 0.2)
    assert [track.shape for track in performance.tracks] == [(12, 2)] * 3
    assert performance.labels == ()
    found = re.fullmatch(r"return ([0-9.]+) in ([0-9]+) steps", performance.summary)
    assert found and 0 < float(found[1]) <= float(found[2]) <= 499


@pytest.mark.slow
def test_a_policy_with_a_goal_is_shown_with_its_goals():
    performance = demo.perform("g1_velocity", 0.3)
    assert len(performance.tracks) == 3
    assert performance.labels == ()
    assert any(marker for figures in performance.markers for marker in figures)
    assert "velocity_error_m_s 0." in performance.summary
    assert "without a fall" in performance.summary


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"policies": ("smal",)}, r"unknown policy 'smal' \(did you mean 'small'\?\)"),
        ({"out": "taken/demo"}, "out=taken/demo: cannot be made"),
    ],
)
@pytest.mark.usefixtures("policies", "gl")
def test_a_mistake_is_refused_before_the_play(
    settings: dict[str, Any], message, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(demo, "perform", lambda *_: pytest.fail("a policy was played"))
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(ConfigError, match=message):
        run_demo(DemoSettings(**settings))


def test_without_policies_the_demo_says_how_to_make_one(monkeypatch, tmp_path):
    monkeypatch.setattr(paths, "shipped_policies_dir", lambda: tmp_path / "policies")
    with pytest.raises(ConfigError, match=r"no policy in .*pack checkpoint="):
        run_demo(DemoSettings())
