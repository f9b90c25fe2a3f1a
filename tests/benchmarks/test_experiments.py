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


def compose_experiment(name: str, clip: Path) -> DictConfig:
    cfg = compose(list(find_experiment(name, str(clip)).settings))
    check_config(cfg)
    return cfg


@pytest.mark.slow
def test_every_experiment_composes(walk_clip):
    for name in EXPERIMENTS:
        cfg = compose_experiment(name, walk_clip)
        entry = _TABLE.experiments[name]
        task = entry.get("task", "HumanoidAMP")
        assert cfg.task.name == compose([f"task={task}", "train=AntPPO"]).task.name
        if "motion_file" in entry:
            expected = str(walk_clip) if needs_motion_file(name) else entry.motion_file
            assert cfg.task.env.motion_file == expected
        elif name != "clips":  # see benchmarks.clips
            assert not needs_motion_file(name)
            assert "motion_file" not in cfg.task.env


def test_variants_change_what_they_say_and_may_be_joined(walk_clip):
    cfg = compose_experiment("walk_mocap+unrepaired+reward_least_squares+fp32", walk_clip)
    assert cfg.task.env.repairRepeatedFrames is False
    assert cfg.train.params.config.disc_reward == "least_squares"
    assert cfg.train.params.config.mixed_precision is False


def test_mistakes():
    for name, clip, message in [
        ("wallk", None, "unknown experiment 'wallk' .did you mean 'walk'"),
        ("walk+fp23", None, "unknown variant 'fp23' .did you mean 'fp32'"),
        ("walk_mocap", None, "'walk_mocap' needs its clip; add --motion-file PATH"),
        ("walk_mocap", "absent.npy", "--motion-file absent.npy: no such file"),
    ]:
        with pytest.raises(ConfigError, match=message):
            find_experiment(name, clip)


def test_values_survive_hydra():
    for value in ["/a/b.pth", "deepmimic:run", "/with space/it's=1,2.pth", "[x]"]:
        assert compose([override("checkpoint", value)]).checkpoint == value
