"""The YAML files of ASE's tasks: what they compose to, and ASE's own files in their place."""

from __future__ import annotations

from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite import schema
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.tasks import isaacgym_task_map
from isaacgymenvs_lite.tasks.ase.humanoid_ase import (
    GetupConfig,
    HumanoidASEConfig,
    HumanoidHeading,
    HumanoidLocation,
    HumanoidReach,
    HumanoidStrike,
    read_ase_config,
)
from isaacgymenvs_lite.tasks.ase.humanoid_ase_getup import HumanoidASEGetup
from isaacgymenvs_lite.tasks.goals import goal_keys

# agent of the default train file, goal and stateInit
TASK_FILES = {
    "HumanoidASE": ("gen_amp", "skill", "Hybrid"),
    "HumanoidASEGetup": ("gen_amp", "skill", "Hybrid"),
    "HumanoidHeading": ("hrl", "heading", "Default"),
    "HumanoidLocation": ("hrl", "location", "Default"),
    "HumanoidPerturb": ("gen_amp", "skill", "Default"),
    "HumanoidReach": ("hrl", "reach", "Default"),
    "HumanoidStrike": ("hrl", "strike", "Default"),
    "HumanoidViewMotion": ("gen_amp", "skill", "Hybrid"),
}
# The keys that all of ASE's files have.
PUBLISHED = {
    "envSpacing": 5,
    "episodeLength": 300,
    "isFlagrun": False,
    "enableDebugVis": False,
    "pdControl": True,
    "powerScale": 1.0,
    "controlFrequencyInv": 2,
    "hybridInitProb": 0.5,
    "numAMPObsSteps": 10,
    "localRootObs": True,
    "contactBodies": ["right_foot", "left_foot"],
    "terminationHeight": 0.15,
    "enableEarlyTermination": True,
    "plane": {"staticFriction": 1.0, "dynamicFriction": 1.0, "restitution": 0.0},
}


def _env(*overrides: str) -> dict[str, Any]:
    """`task.env` of a composition, checked as before a launch."""
    cfg = compose([*overrides])
    check_config(cfg)
    return _plain_env(cfg)


def _plain_env(cfg: DictConfig) -> dict[str, Any]:
    env = OmegaConf.to_container(cfg.task.env, resolve=True)
    assert isinstance(env, dict)
    return {str(key): value for key, value in env.items()}


# --- our files --------------------------------------------------------------------------------


def test_every_task_of_ase_has_its_files_here() -> None:
    of_ase = {name for name, task in isaacgym_task_map.items() if ".tasks.ase." in task.__module__}
    assert set(TASK_FILES) == of_ase


def test_a_task_file_composes_with_its_train_file() -> None:
    for task in TASK_FILES:
        agent, goal, state_init = TASK_FILES[task]
        cfg = compose([f"task={task}", "num_envs=6"])
        check_config(cfg)
        assert (cfg.task.name, cfg.train.params.algo.name) == (task, agent)
        assert cfg.task.env.numEnvs == cfg.train.params.config.num_actors == 6
        assert (cfg.task.env.goal, cfg.task.env.stateInit) == (goal, state_init)
        assert cfg.task.sim.dt == pytest.approx(1.0 / 60.0, abs=1e-15)
        assert cfg.task.sim.substeps == 2


def test_the_goal_follows_the_agent() -> None:
    assert _env("task=HumanoidASE")["goal"] == "skill"
    assert _env_on_a_gpu("HumanoidASE")["goal"] == "none"
    assert _env("task=HumanoidASE", "train=HumanoidAMPPPO")["goal"] == "none"
    assert _env("task=HumanoidASE", "train=HumanoidASEHRLPPO")["goal"] == "heading"
    chosen = ("task=HumanoidASE", "train=HumanoidASEHRLPPO", "task.env.goal=strike")
    assert _env(*chosen)["goal"] == "strike"


def _env_on_a_gpu(task: str) -> dict[str, Any]:
    """`task.env` where learning runs on a GPU, which this machine need not have: not checked."""
    return _plain_env(compose([f"task={task}", "rl_device=cuda:0"]))


def test_values_of_the_file_are_the_defaults_in_the_code() -> None:
    env = _env_on_a_gpu("HumanoidASE")
    assert read_ase_config(env) == HumanoidASEConfig()
    getup = _env_on_a_gpu("HumanoidASEGetup")
    assert read_ase_config(getup, GetupConfig) == GetupConfig()
    # All goals' keys are there to be overridden, and have the goals' own values.
    given = {key: env[key] for key in goal_keys()}
    assert {key for key, value in given.items() if value is not None} == {
        *("enableTaskObs", "reachObsRelative"),
    }


@pytest.mark.slow
def test_skills_are_learned_on_a_cpu_in_short_episodes_and_played_in_long_ones() -> None:
    for task in ["HumanoidASE", "HumanoidASEGetup"]:
        learned, played = (
            _env(f"task={task}"),
            _env(f"task={task}", "test=True", "checkpoint=x.pth"),
        )
        assert [learned[key] for key in ("episodeLength", "hybridInitProb")] == [150, 0.75]
        assert played["episodeLength"] == 300
        for train in ("HumanoidASEHRLPPO", "HumanoidASETaskPPO"):
            assert _env(f"task={task}", f"train={train}")["episodeLength"] == 300


def test_values_of_the_file_are_ase_s() -> None:
    env = _env_on_a_gpu("HumanoidASE")
    # A viewer's key that ours does without.
    expected = {key: value for key, value in PUBLISHED.items() if key != "isFlagrun"}
    assert {key: env[key] for key in expected} == expected
    getup = _env_on_a_gpu("HumanoidASEGetup")
    keys = ("recoveryEpisodeProb", "recoverySteps", "fallInitProb")
    assert [getup[key] for key in keys] == [0.2, 60, 0.1]


# --- ASE's files ------------------------------------------------------------------------------

SWORD_AND_SHIELD = {
    "asset": {"assetFileName": "mjcf/amp_humanoid_sword_shield.xml"},
    "keyBodies": ["right_hand", "left_hand", "right_foot", "left_foot", "sword", "shield"],
}
TIMED = {"enableTaskObs": True, "tarChangeStepsMin": 100, "tarChangeStepsMax": 200}


def test_ase_s_flat_files_work(make_ase, monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    for cls, keys, num_obs in [
        (
            HumanoidHeading,
            {
                **{"tarSpeedMin": 1.5, "tarSpeedMax": 1.6, "enableRandHeading": True},
                **{"headingChangeStepsMin": 100, "headingChangeStepsMax": 200},
                "enableTaskObs": True,
            },
            258,
        ),
        (HumanoidLocation, {**TIMED, "tarSpeed": 1.0, "tarDistMax": 10.0}, 255),
        (
            HumanoidReach,
            {
                **{"enableTaskObs": True, "tarChangeStepsMin": 50, "tarChangeStepsMax": 100},
                **{"tarSpeed": 1.0, "tarDistMax": 1.0, "tarHeightMin": 0.2, "tarHeightMax": 2.0},
                "reachBodyName": "sword",
            },
            256,
        ),
        (
            HumanoidStrike,
            {
                "enableTaskObs": True,
                "strikeBodyNames": ["sword", "right_hand", "right_lower_arm"],
            },
            268,
        ),
        (
            HumanoidASEGetup,
            {
                **{"recoveryEpisodeProb": 0.2, "recoverySteps": 60, "fallInitProb": 0.1},
                "stateInit": "Hybrid",
            },
            253,
        ),
    ]:
        schema.LOGGED_KEYS.clear()
        env = {"stateInit": "Default", **PUBLISHED, **SWORD_AND_SHIELD, **keys}
        task = make_ase(1, cls=cls, armed=True, **env)
        assert task.num_obs == num_obs
        assert task.num_amp_obs == 1400
        # Every key is read, or known to be without effect.
        assert not [message for message in caplog.messages if "nothing reads" in message]
