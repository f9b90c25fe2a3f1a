"""Clips and models that a task file names from its own checkout."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import make_from_config
from isaacgymenvs_lite.errors import ConfigError, MotionFileError
from isaacgymenvs_lite.motion.formats.poselib import save_poselib_npy
from isaacgymenvs_lite.motion.loader import load_clips, shipped_motions_dir
from isaacgymenvs_lite.paths import assets_dir

CLIP = "amp_humanoid_run.npy"
FORK = f"""\
name: HumanoidAMP
env:
  numEnvs: ${{resolve_default:4096,${{...num_envs}}}}
  motion_file: "{CLIP}"
  asset:
    assetFileName: "mjcf/amp_humanoid.xml"
sim:
  dt: 0.0166
  substeps: 2
"""
ASE = """\
env:
  numEnvs: 4096
  motion_file: ase/data/motions/own/set.yaml
  asset:
    assetRoot: "ase/data/assets"
    assetFileName: "mjcf/amp_humanoid.xml"
sim:
  substeps: 2
"""


@pytest.fixture(scope="module")
def checkouts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a fork of IsaacGymEnvs and one of ASE, laid out as they are."""
    root = tmp_path_factory.mktemp("checkouts")
    files = {
        "ige/isaacgymenvs/cfg/task/HumanoidAMP.yaml": FORK,
        "ase/ase/data/cfg/humanoid.yaml": ASE,
        "ase/ase/data/motions/own/set.yaml": f"motions:\n- {{file: {CLIP}, weight: 1}}\n",
        # which MuJoCo refuses, as it does ASE's
        "ase/ase/data/assets/mjcf/amp_humanoid.xml": "<mujoco><worldbody><geom/></mujoco>",
    }
    clips = ("ige/assets/amp/motions", "ase/ase/data/motions/own")
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    for folder in clips:
        (root / folder).mkdir(parents=True, exist_ok=True)
        save_poselib_npy(root / folder / CLIP, load_clips("walk")[0][0])
    return root


@pytest.fixture
def ige(checkouts: Path) -> Path:
    return checkouts / "ige/isaacgymenvs/cfg/task/HumanoidAMP.yaml"


@pytest.fixture
def ase(checkouts: Path) -> Path:
    return checkouts / "ase/ase/data/cfg/humanoid.yaml"


def tree(file: Path, *overrides: str, train: str = "HumanoidAMPPPO") -> DictConfig:
    return compose([f"task={file}", f"train={train}", "num_envs=1", "num_threads=1", *overrides])


def clip_of(cfg: Any) -> str:
    task: Any = make_from_config(cfg, sim_device="cpu", rl_device="cpu")
    task.reset()
    task.close()
    return str(task.env_cfg.motion_file)


def test_the_clip_of_a_fork_is_found_from_anywhere(ige: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    clip = ige.parents[3] / "assets/amp/motions" / CLIP
    assert clip_of(tree(ige)) == str(clip)
    # by its path in the checkout, and typed
    typed = tree(ige, f"task.env.motion_file=assets/amp/motions/{CLIP}")
    assert clip_of(typed) == str(clip)
    # what lies in the working folder goes first, what is shipped last
    shutil.copy(clip, tmp_path / CLIP)
    assert clip_of(tree(ige)) == str(tmp_path / CLIP)
    assert clip_of(tree(ige, "task.env.motion_file=jump")) == str(
        shipped_motions_dir() / "jump.npz"
    )


def test_a_stored_tree_finds_it_again(ige: Path, tmp_path: Path, monkeypatch) -> None:
    """What a run writes into its folder is enough, wherever it is read."""
    stored = OmegaConf.create(OmegaConf.to_yaml(tree(ige)))
    monkeypatch.chdir(tmp_path)
    assert clip_of(stored) == str(ige.parents[3] / "assets/amp/motions" / CLIP)


def test_a_data_set_and_models_of_ase(
    ase: Path, checkouts: Path, tmp_path: Path, monkeypatch
) -> None:
    for folder in ["elsewhere", "ase"]:
        monkeypatch.chdir(checkouts / "ase" if folder == "ase" else tmp_path)
        cfg = tree(ase, train="HumanoidASEPPO")
        assert clip_of(cfg) == str(checkouts / "ase/ase/data/motions/own/set.yaml")


def test_what_is_nowhere_lists_where_it_was_looked_for(ige: Path, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(MotionFileError) as found:
        clip_of(tree(ige, "task.env.motion_file=nowhere.npy"))
    top = ige.parents[3]
    for folder in (tmp_path, top, top / "assets/amp/motions", shipped_motions_dir()):
        assert f"{folder} and" in str(found.value) or f"{folder};" in str(found.value)


def test_clips_of_the_armed_humanoid_that_are_missing_have_a_way_out(ase: Path) -> None:
    """ASE's checkout is without them; the words of the message make a task that runs."""
    armed = (
        "task.env.asset.assetFileName=mjcf/amp_humanoid_sword_shield.xml",
        "task.env.motion_file=ase/data/motions/reallusion_sword_shield/set.yaml",
        "task.env.keyBodies=[right_hand,left_hand,right_foot,left_foot,sword,shield]",
    )
    with pytest.raises(MotionFileError, match=r"^task.env.motion_file: .*deepmimic:walk") as found:
        clip_of(tree(ase, *armed, train="HumanoidASEPPO"))
    words = shlex.split(str(found.value).partition("without weapons: ")[2])
    assert clip_of(tree(ase, *armed, *words, train="HumanoidASEPPO")).endswith("locomotion.yaml")


def test_nothing_outside_the_checkout_is_found(ige: Path, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    beside = ige.parents[4] / "secret.npy"
    shutil.copy(ige.parents[3] / "assets/amp/motions" / CLIP, beside)
    for name in ("../secret.npy", "../../../../secret.npy", "secret.npy"):
        with pytest.raises(MotionFileError, match="not found"):
            clip_of(tree(ige, f"task.env.motion_file={name}"))


def test_a_model_of_the_fork(tmp_path: Path, monkeypatch) -> None:
    top = tmp_path / "fork"
    file = top / "isaacgymenvs/cfg/task/LongAnt.yaml"
    file.parent.mkdir(parents=True)
    shutil.copytree(assets_dir() / "mjcf", top / "assets/mjcf")
    (top / "assets/mjcf/ant.xml").rename(top / "assets/mjcf/long_ant.xml")
    text = "defaults: [Ant, _self_]\nenv:\n  asset:\n    assetFileName: mjcf/long_ant.xml\n"
    for root in ("", "    assetRoot: ../../assets\n"):
        file.write_text(text + root)
        task = make_from_config(tree(file, train="AntPPO"), sim_device="cpu", rl_device="cpu")
        assert task.num_obs == 60
        task.close()
    # published names stand for this project's models, also where a checkout has files of theirs
    (top / "assets/mjcf/nv_ant.xml").write_text("<mujoco><broken/></mujoco>")
    file.write_text(text.replace("long_ant", "nv_ant"))
    make_from_config(tree(file, train="AntPPO"), sim_device="cpu", rl_device="cpu").close()
    file.write_text(text.replace("long_ant", "lost"))
    with pytest.raises(ConfigError, match=rf"mjcf/lost.xml': no such file in .*{top}/assets, "):
        make_from_config(tree(file, train="AntPPO"), sim_device="cpu", rl_device="cpu")
