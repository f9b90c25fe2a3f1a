"""Measures skills and goals of briefly trained levels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import hierarchy
from benchmarks.protocol import SEED, evaluate_checkpoint, play_checkpoint
from benchmarks.runs import Run
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.runner import run as train
from tests.tiny import CONFIG, TINY_DISCRIMINATOR, TINY_PPO, TINY_STYLE

pytestmark = pytest.mark.slow

TINY = ("task.env.motion_file=stand", *TINY_PPO, "max_iterations=1")
LOW_LEVEL = (*TINY_STYLE, *TINY_DISCRIMINATOR)


def train_run(folder: Path, name: str, *settings: str) -> Path:
    own = [f"+full_experiment_name={name}_seed1", f"+{CONFIG}.train_dir={folder}", "seed=1"]
    train(compose([*TINY, *settings, *own]))
    checkpoint = Run.of(folder, name, 1).newest_checkpoint()
    assert checkpoint is not None
    return checkpoint


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with runs of a low level, its high level, and a policy without levels."""
    folder = tmp_path_factory.mktemp("runs")
    threads = torch.get_num_threads()  # a run changes the whole process
    low = train_run(folder, "skills", "task=HumanoidASE", *LOW_LEVEL)
    llc = folder / "llc.yaml"
    llc.write_text(
        "defaults: [HumanoidASEPPO]\n"
        "params: {network: {mlp: {units: [16, 8]}, style: {units: [10, 6]},"
        " disc: {units: [12, 6]}}}\n"
    )
    own = (f"{CONFIG}.llc_config={llc}", f"{CONFIG}.llc_checkpoint={low}")
    train_run(folder, "heading_hrl", "task=HumanoidHeading", *own)
    train_run(folder, "heading_ppo", "task=HumanoidHeading", "train=HumanoidASETaskPPO")
    torch.set_num_threads(threads)
    return folder


@pytest.fixture(autouse=True)
def few_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hierarchy, "EPISODES", 6)


def measured(runs: Path, out: Path, *words: str) -> dict:
    hierarchy.main([*words, "--runs-dir", str(runs), "--write", "--results-dir", str(out)])
    (file,) = out.iterdir()
    (line,) = file.read_text().splitlines()
    return {"file": file.stem, **json.loads(line)}


def test_skills(runs, tmp_path, capsys) -> None:
    found = measured(runs, tmp_path, "skills", "skills", "task.env.episodeLength=40")
    assert found["file"] == found["experiment"] == "skills"
    assert (found["seed"], found["frames"], found["num_episodes"]) == (1, 16, 6)
    # The data set of the run is one clip.
    assert (found["coverage"], found["clip_shares"]) == (1.0, {"stand": 1.0})
    assert 0.0 <= found["encoder_reward"] <= 1.0
    assert found["no_fall_share"] == 0.0
    assert "skills seed 1: coverage 1.00" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["skills", "heading_hrl", "heading_ppo"])
def test_the_imitation_of_every_level_is_measured(runs, name) -> None:
    """Measure the policy like `benchmarks.learning` after a training."""
    run = Run.of(runs, name, 1)
    checkpoint = run.newest_checkpoint()
    assert checkpoint is not None and run.has_motions()
    settings = ("num_envs=2", "task.env.numEnvs=2", "task.env.episodeLength=5")
    outcome = evaluate_checkpoint(checkpoint, overrides=settings)
    assert outcome.imitation.mean_episode_steps > 0


def test_getting_up(runs, tmp_path, capsys) -> None:
    checkpoint = train_run(runs, "getup", "task=HumanoidASEGetup", *LOW_LEVEL)

    def start_heights(player: Any, env: Any) -> torch.Tensor:
        env.reset()
        return env.simulation.root_states[:, 2].clone()

    lying = play_checkpoint(checkpoint, start_heights, hierarchy.fixed_settings("getup"), SEED)
    assert lying.max() < 0.6  # m; standing 0.89
    standing = play_checkpoint(checkpoint, start_heights, hierarchy.fixed_settings("skills"), SEED)
    assert standing.min() > 0.8
    found = measured(runs, tmp_path, "getup", "getup", "task.env.episodeLength=95")
    assert found["got_up_share"] == 0.0  # nobody gets up by chance
    assert "getup seed 1: got up within 3 s" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="HumanoidASE never starts on the ground"):
        hierarchy.main(["getup", "skills", "--runs-dir", str(runs)])


@pytest.mark.parametrize("name", ["heading_hrl", "heading_ppo"])
def test_goals(name, runs, tmp_path) -> None:
    found = measured(runs, tmp_path, "goal", name)
    assert found["file"] == name
    # The humanoid falls in the first two of ten seconds and gets some reward before.
    assert 0.0 < found["task_return"] < 0.2
    assert found["no_fall_share"] == 0.0
    # The untrained discriminator pays about 2 ln 2 per step. The shipped one pays little for falls.
    bounds = (0.8, 1.8) if name == "heading_hrl" else (0.0, 0.8)
    assert bounds[0] < found["style_reward"] < bounds[1]
