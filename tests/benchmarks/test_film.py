"""Films trained policies."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.film import main
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.rendering.gl import ensure_gl
from isaacgymenvs_lite.runner import run

av = pytest.importorskip("av")
ensure_gl()


def _train(folder: Path, *settings: str) -> Path:
    fixed = ("max_iterations=1", "seed=1", "rl_device=cpu", "num_threads=1")
    name = ("+full_experiment_name=film_seed1", f"+train.params.config.train_dir={folder}")
    run(compose([*settings, *fixed, *name]))
    return folder / "film_seed1"


def _pictures(file: Path) -> list:
    with av.open(str(file)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_a_classic_policy_is_filmed_in_a_panel_for_each_environment(tmp_path, capsys):
    folder = _train(tmp_path, "task=BallBalance", "num_envs=64")
    out = tmp_path / "balls.mp4"
    main([str(folder), "--out", str(out), "--seconds", "0.4", "--envs", "2"])
    assert f"wrote {out}" in capsys.readouterr().out
    pictures = _pictures(out)
    assert len(pictures) == 8  # 0.4 s at 20 pictures a second
    assert pictures[0].shape == (300, 400, 3)
    assert abs(pictures[0].astype(int) - pictures[-1]).max() > 50  # it moves


@pytest.mark.slow
def test_a_policy_that_imitates_is_filmed_beside_its_clip(tmp_path):
    folder = _train(tmp_path, "task=HumanoidAMP", "num_envs=128")
    out = tmp_path / "walk.mp4"
    main([str(folder), "--out", str(out), "--seconds", "0.2"])
    first = _pictures(out)[0].astype(int)
    assert first.shape == (300, 400, 3)
    clip, policy = first[:, :200], first[:, 200:]
    assert clip.std() > 10 and policy.std() > 10  # somebody in each panel
    assert abs(clip - policy).max() > 50  # with a label and a pose of its own


def test_a_folder_without_a_policy_is_one_line(tmp_path):
    with pytest.raises(SystemExit, match="error: "):
        main([str(tmp_path), "--out", str(tmp_path / "x.webp")])
