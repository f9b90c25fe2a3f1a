from __future__ import annotations

from pathlib import Path

import pytest
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from isaacgymenvs_lite.checkpoints.packed import pack_policy, read_policy_info
from isaacgymenvs_lite.checkpoints.policy_arguments import playing_overrides
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import seed_everything
from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.evaluation.evaluate import EvaluationResult
from isaacgymenvs_lite.motion.loader import shipped_robot_motions_dir
from isaacgymenvs_lite.paths import shipped_policies
from isaacgymenvs_lite.runner import load_player
from tests.tiny import fast_and_slow


def play(cfg: DictConfig) -> tuple[list[Tensor], EvaluationResult]:
    """Four episodes of at most five steps: all actions, and what was measured."""
    if "learn" in cfg.task.env:  # Anymal's keys
        cfg.task.env.learn.episodeLength_s = 0.12
    else:
        cfg.task.env.episodeLength = 6
    with load_player(cfg) as player:
        actions, act = list[Tensor](), player.act
        player.act = lambda obs: actions.append(act(obs)) or actions[-1]
        player.games_num = 4
        seed_everything(5)
        player.run()
        return actions, player.result


def test_a_packed_policy_acts_and_judges_as_the_checkpoint(full_checkpoint, shipped_dir):
    """Bit by bit; the full one with its run's settings, the packed one with what it carries."""
    pack_policy(full_checkpoint, "tiny")
    stored = OmegaConf.load(full_checkpoint.parents[1] / "config.yaml")
    assert isinstance(stored, DictConfig)
    stored.update({"test": True, "checkpoint": str(full_checkpoint)})
    fixed = ("test=True", "checkpoint=tiny", "num_envs=4", "num_threads=1", "rl_device=cpu")
    expected_actions, expected = play(stored)
    actions, found = play(compose([*playing_overrides("tiny"), *fixed]))
    for one, other in zip(expected_actions, actions, strict=True):
        assert torch.equal(one, other)
    assert actions[0].abs().sum() > 0
    assert (found.reward, found.steps) == (expected.reward, expected.steps)
    assert found.style_reward == expected.style_reward is not None


def test_a_packed_policy_holds_no_state_of_its_training(full_checkpoint, shipped_dir):
    path = pack_policy(full_checkpoint, "tiny")
    assert path == shipped_dir / "tiny.pth"
    state = load_checkpoint(path)
    assert set(state) == {"model", "amp_input_mean_std", "policy"}
    assert path.stat().st_size < 0.6 * full_checkpoint.stat().st_size


def test_what_a_packed_policy_says_of_itself(full_checkpoint, shipped_dir):
    info = read_policy_info(pack_policy(full_checkpoint, "tiny"))
    assert (info.task, info.clip) == ("HumanoidAMP", "walk.npz")
    assert info.units == {"mlp": [16, 8], "disc": [12, 6]}
    assert (info.frames, info.epochs) == (32, 2)  # 4 environments * 4 steps * 2 epochs
    assert info.training["learning_rate"] == 1e-3
    assert info.training["gamma"] == 0.99
    assert "train_dir" not in info.training
    assert info.settings["task.env.localRootObs"] is True
    assert info.settings["train.params.algo.name"] == "amp_continuous"
    # sizes and devices are those of whoever plays it
    for path in ("task.env.numEnvs", "task.env.episodeLength", "task.sim.physx.num_threads"):
        assert path not in info.settings
    assert str(info) == ("HumanoidAMP of walk.npz, 0.0 M frames, mlp [16, 8], disc [12, 6]")


def test_a_configuration_of_another_network_is_refused(edited_run, shipped_dir):
    checkpoint = edited_run("        - 16\n        - 8\n", "        - 32\n")
    with pytest.raises(CheckpointError, match=r"\[16, 8\].*config\.yaml.*\[32\]") as caught:
        pack_policy(checkpoint, "tiny")
    assert "\n" not in str(caught.value)
    assert list(shipped_dir.iterdir()) == []


def test_a_checkpoint_without_its_run_is_refused(full_checkpoint, shipped_dir, tmp_path):
    (tmp_path / "alone.pth").write_bytes(full_checkpoint.read_bytes())
    with pytest.raises(ConfigError, match=r"no config\.yaml"):
        pack_policy(tmp_path / "alone.pth", "tiny")


def test_a_damaged_configuration_is_refused(edited_run, shipped_dir):
    checkpoint = edited_run()
    for content in ["", "task: 3\n", "rl_device: cpu\ntask: {env: {a: 1}}\n"]:
        (checkpoint.parents[1] / "config.yaml").write_text(content)
        with pytest.raises(ConfigError, match=r"config\.yaml") as caught:
            pack_policy(checkpoint, "tiny")
        assert "\n" not in str(caught.value)


def test_a_clip_of_this_machine_only_is_refused_or_replaced(edited_run, shipped_dir):
    checkpoint = edited_run("motion_file: walk.npz", "motion_file: /home/me/mine.npy")
    with pytest.raises(ConfigError, match=r"/home/me/mine\.npy.*clip=.*run, .*walk"):
        pack_policy(checkpoint, "tiny")
    with pytest.raises(ConfigError, match="wlak"):
        pack_policy(checkpoint, "tiny", clip="wlak")
    info = read_policy_info(pack_policy(checkpoint, "tiny", clip="run"))
    assert info.clip == info.settings["task.env.motion_file"] == "run"
    # a robot's, by the path that a run has of it
    clip = str(shipped_robot_motions_dir() / "g1_walk.npz")
    assert read_policy_info(pack_policy(checkpoint, "tiny", clip=clip)).clip == "g1_walk.npz"


def test_a_name_that_cannot_be_used_is_refused(full_checkpoint, shipped_dir):
    for name in ["", "last", "Walk", "../walk", "a b", ".walk"]:
        with pytest.raises(ConfigError, match=f"name={name}: expected"):
            pack_policy(full_checkpoint, name)


def test_a_full_checkpoint_is_no_packed_policy(full_checkpoint):
    with pytest.raises(CheckpointError, match="is no packed policy") as caught:
        read_policy_info(full_checkpoint)
    assert "\n" not in str(caught.value)


# --- what ships -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", fast_and_slow({name: name for name in shipped_policies()}, "walk", "g1_velocity")
)
def test_a_shipped_policy_plays_anywhere(name):
    info = read_policy_info(shipped_policies()[name])
    assert not Path(info.clip).is_absolute()
    assert info.frames > 0
    fixed = ["test=True", f"checkpoint={name}", "num_envs=2", "num_threads=1", "rl_device=cpu"]
    if info.missing():
        fixed.append("task.env.motion_file=walk")
    actions, _ = play(compose([*playing_overrides(name), *fixed]))
    assert torch.stack(actions).isfinite().all()


@pytest.mark.slow
def test_the_shipped_g1_goes_as_commanded():
    for command in [(0.8, 0.0, 0.0), (0.4, 0.0, 0.6), (0.0, 0.0, 0.0)]:
        axes = zip(("linear_x", "linear_y", "yaw"), command, strict=True)
        ranges = [f"task.env.randomCommandVelocityRanges.{a}=[{v},{v}]" for a, v in axes]
        fixed = (
            "test=True",
            "checkpoint=g1_velocity",
            "num_envs=4",
            "num_threads=1",
            "rl_device=cpu",
        )
        words = [*playing_overrides("g1_velocity"), *fixed, *ranges, "seed=1"]
        with load_player(compose([*words, "task.env.stateInit=Default"])) as player:
            obs, env = player.env.reset(), player.env
            for _ in range(120):
                obs, _, dones, _ = env.step(player.act(obs))
                assert not dones.any()
            errors = env.goal.errors()
        # In the last of four seconds; over all commands the means are 0.18 m/s and 0.14 rad/s.
        assert float(errors["velocity_error_m_s"].max()) < 0.4
        assert float(errors["turn_error_rad_s"].max()) < 0.4
