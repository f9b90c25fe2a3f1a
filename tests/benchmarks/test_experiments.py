from __future__ import annotations

from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

from benchmarks.experiments import TABLE, find_experiment, needs_motion_file, override
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.errors import ConfigError

_TABLE = OmegaConf.load(TABLE)
EXPERIMENTS = [str(name) for name in _TABLE.experiments]
VARIANTS = [str(name) for name in _TABLE.variants]


def compose_experiment(name: str, clip: Path) -> DictConfig:
    cfg = compose(list(find_experiment(name, str(clip)).settings))
    check_config(cfg)
    return cfg


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_composes(name, walk_clip):
    cfg = compose_experiment(name, walk_clip)
    entry = _TABLE.experiments[name]
    task = entry.get("task", "HumanoidAMP")
    assert cfg.task.name == compose([f"task={task}", "train=AntPPO"]).task.name
    if "motion_file" in entry:
        expected = str(walk_clip) if needs_motion_file(name) else entry.motion_file
        assert cfg.task.env.motion_file == expected
    elif name != "clips":  # one for each clip, see benchmarks.clips
        assert not needs_motion_file(name)
        assert "motion_file" not in cfg.task.env


def test_every_variant_composes(walk_clip):
    for variant in VARIANTS:
        of_skills = ("mismatched_demos", "matched_demos", "diversity")
        base = "skills" if variant in of_skills else "walk"
        compose_experiment(f"{base}+{variant}", walk_clip)


def test_variants_change_what_they_say_and_may_be_joined(walk_clip):
    cfg = compose_experiment("walk_mocap+unrepaired+reward_least_squares+fp32", walk_clip)
    assert cfg.task.env.repairRepeatedFrames is False
    assert cfg.train.params.config.disc_reward == "least_squares"
    assert cfg.train.params.config.mixed_precision is False


def test_further_overrides_win(walk_clip):
    experiment = find_experiment("walk+fp32", None, ["train.params.config.mixed_precision=True"])
    assert compose(list(experiment.settings)).train.params.config.mixed_precision is True


@pytest.mark.parametrize(
    ("name", "clip", "message"),
    [
        ("wallk", None, "unknown experiment 'wallk' .did you mean 'walk'"),
        ("walk+fp23", None, "unknown variant 'fp23' .did you mean 'fp32'"),
        ("walk_mocap", None, "'walk_mocap' needs its clip: --motion-file PATH"),
        ("walk_mocap", "absent.npy", "--motion-file absent.npy: no such file"),
    ],
)
def test_mistakes(name, clip, message):
    with pytest.raises(ConfigError, match=message):
        find_experiment(name, clip)


@pytest.mark.parametrize("value", ["/a/b.pth", "deepmimic:run", "/with space/it's=1,2.pth", "[x]"])
def test_values_survive_hydra(value):
    assert compose([override("checkpoint", value)]).checkpoint == value
