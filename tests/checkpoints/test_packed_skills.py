"""A low-level controller as a packed policy: played, and used by a hierarchy."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from isaacgymenvs_lite.checkpoints.packed import pack_policy, read_policy_info
from isaacgymenvs_lite.checkpoints.policy_arguments import playing_overrides
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import make_from_config
from isaacgymenvs_lite.errors import CheckpointError
from isaacgymenvs_lite.learning.skills.low_level_policy import LowLevelPolicy, LowLevelSizes
from isaacgymenvs_lite.runner import run
from isaacgymenvs_lite.utils import precision
from tests.tiny import CONFIG, TINY_AMP, TINY_PPO, TINY_STYLE, train_in

_TINY = (
    "task=HumanoidASE",
    "task.env.motion_file=stand",
    *TINY_AMP,
    *TINY_STYLE,
    f"{CONFIG}.latent_dim=5",
    f"{CONFIG}.learning_rate=1e-3",
)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A low-level controller after one epoch, in its run folder."""
    return train_in(tmp_path_factory.mktemp("project"), _TINY) / "nn" / "HumanoidASE.pth"


def test_it_knows_its_latents_and_layers(checkpoint, shipped_dir) -> None:
    info = read_policy_info(pack_policy(checkpoint, "skills"))
    assert info.units == {"mlp": [16, 8], "style": [10, 6], "disc": [12, 6]}
    assert (info.task, info.clip) == ("HumanoidASE", "stand")
    cfg = compose([*playing_overrides("skills"), "num_envs=2"])
    assert cfg.train.params.config.latent_dim == 5
    assert cfg.task.env.goal == "skill"


def test_a_hierarchy_takes_it_by_name(checkpoint, shipped_dir, tmp_path, monkeypatch) -> None:
    """It says itself which networks and latents it has; of a checkpoint the train file does."""
    # Each of the two measures for itself otherwise, and beside other work may find another answer.
    monkeypatch.setattr(precision, "measure_bfloat16_speedup", lambda: 1.0)
    pack_policy(checkpoint, "skills")
    cfg = compose(
        ["task=HumanoidHeading", "num_envs=4", "num_threads=1", "task.env.motion_file=stand"]
    )
    task = make_from_config(cfg, sim_device="cpu", rl_device="cpu")
    train_file = tmp_path / "llc.yaml"
    train_file.write_text(
        "defaults: [HumanoidASEPPO]\n"
        "params:\n"
        "  network: {mlp: {units: [16, 8]}, style: {units: [10, 6]}, disc: {units: [12, 6]}}\n"
        "  config: {latent_dim: 5}\n"
    )
    sizes = LowLevelSizes.from_task(task)
    by_name = LowLevelPolicy("HumanoidASEPPO", "skills", sizes, "cpu")
    by_path = LowLevelPolicy(str(train_file), str(checkpoint), sizes, "cpu")
    assert by_name.params == by_path.params
    obs = torch.randn(3, task.num_obs, generator=torch.Generator().manual_seed(0))
    latents = torch.nn.functional.normalize(torch.ones(3, 5), dim=-1)
    assert torch.equal(by_name.actions(obs, latents), by_path.actions(obs, latents))
    task.close()


@pytest.mark.slow
def test_a_high_level_is_packed_after_its_low_level(checkpoint, shipped_dir, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = (
        "task=HumanoidHeading",
        "task.env.motion_file=stand",
        *TINY_PPO,
        f"{CONFIG}.llc_config={checkpoint.parents[1] / 'config.yaml'}",
    )
    low = f"train.params.config.llc_checkpoint={checkpoint}"
    run(compose([*words, low, "max_iterations=1"]))
    high, *others = tmp_path.glob("runs/*/nn/*.pth")
    # The newest checkpoint says which low level it needs.
    run(compose([*words, "test=True", "checkpoint=last", "task.env.episodeLength=5"]))
    with pytest.raises(CheckpointError, match=r"HumanoidASE.pth, which does not ship; pack that"):
        pack_policy(high, "heading")
    pack_policy(checkpoint, "skills")
    packed = pack_policy(high, "heading")
    assert load_checkpoint(packed)["llc"]["checkpoint"] == "skills"
    assert str(checkpoint.parents[1]) not in str(read_policy_info(packed).settings)
    # Played with the files of its training gone.
    for file in (high, *others):
        file.unlink()
    cfg = compose([*playing_overrides("heading"), *words[3:4], "test=True", "num_envs=4"])
    cfg.checkpoint = str(packed)
    cfg.task.env.episodeLength = 5
    run(cfg)
