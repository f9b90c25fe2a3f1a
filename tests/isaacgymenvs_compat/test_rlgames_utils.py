"""rl_games' Runner over what IsaacGymEnvs' `utils.rlgames_utils` has names for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from rl_games.common import env_configurations, vecenv
from rl_games.torch_runner import Runner

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import make_from_config
from isaacgymenvs_lite.isaacgymenvs_compat.reformat import omegaconf_to_dict
from isaacgymenvs_lite.isaacgymenvs_compat.rlgames_utils import (
    ComplexObsRLGPUEnv,
    RLGPUAlgoObserver,
    RLGPUEnv,
    get_rlgames_env_creator,
    multi_gpu_get_rank,
)
from isaacgymenvs_lite.isaacgymenvs_compat.utils import set_seed
from isaacgymenvs_lite.registration import register_env


def test_a_runner_of_ones_own_trains(tmp_path: Path, monkeypatch) -> None:
    cfg = compose(["task=Cartpole", "num_envs=8", "max_iterations=1", "num_threads=1"])
    hooked: list[bool] = []
    create = get_rlgames_env_creator(
        *(3, omegaconf_to_dict(cfg.task), "Cartpole", "cpu", "cpu", -1, True),
        post_create_hook=lambda: hooked.append(True),
    )
    env = create()
    monkeypatch.setitem(
        env_configurations.configurations,
        "rlgpu",
        {"vecenv_type": "RLGPU", "env_creator": lambda **kwargs: env},
    )
    monkeypatch.setitem(vecenv.vecenv_config, "RLGPU", RLGPUEnv)
    params = omegaconf_to_dict(cfg.train)["params"]
    params["config"] |= {
        **{"device": "cpu", "device_name": "cpu", "minibatch_size": 128},
        **{"train_dir": str(tmp_path), "torch_compile": False, "mixed_precision": False},
    }
    threads = torch.get_num_threads()
    try:
        runner = Runner(RLGPUAlgoObserver())
        runner.load({"params": params})
        runner.reset()
        runner.run({"train": True, "play": False, "checkpoint": None, "sigma": None})
    finally:
        torch.set_num_threads(threads)
        env.close()
        register_env()
    assert hooked == [True]
    assert list(tmp_path.glob("*/nn/*.pth"))


def test_seeds_of_processes_differ(monkeypatch) -> None:
    monkeypatch.setenv("LOCAL_RANK", "2")
    assert (multi_gpu_get_rank(False), multi_gpu_get_rank(True)) == (0, 2)
    assert set_seed(5, rank=2) == 7
    first = torch.rand(3), np.random.rand(3)
    set_seed(7)
    torch.testing.assert_close(torch.rand(3), first[0])
    np.testing.assert_array_equal(np.random.rand(3), first[1])


def test_an_environment_with_several_inputs(monkeypatch) -> None:
    words = ["task=Cartpole", "num_envs=3", "num_threads=1", "rl_device=cpu"]
    cfg = compose([*words, "task.env.asymmetric_observations=True"])
    env = make_from_config(cfg, sim_device="cpu", rl_device="cpu")
    creator = {"vecenv_type": "RLGPU", "env_creator": lambda **kwargs: env}
    monkeypatch.setitem(env_configurations.configurations, "rlgpu", creator)
    spec = {
        "obs": {"names": ["obs", "states"], "concat": True, "space_name": "observation_space"},
        "states": {"names": ["states"], "concat": False, "space_name": "state_space"},
    }
    try:
        wrapped = ComplexObsRLGPUEnv("rlgpu", 3, spec)
        info = wrapped.get_env_info()
        assert info["observation_space"].shape == (8,)
        assert info["state_space"]["states"].shape == (4,)
        assert info["action_space"].shape == (1,)
        first = wrapped.reset()
        stepped, rewards, _, _ = wrapped.step(torch.zeros(3, 1))
        done, env_ids = wrapped.reset_done()
    finally:
        env.close()
    for given in (first, stepped, done):
        assert given["obs"].shape == (3, 8)
        # This task measures without noise.
        torch.testing.assert_close(given["obs"][:, 4:], given["states"]["states"])
        torch.testing.assert_close(given["obs"][:, :4], given["states"]["states"])
    assert (rewards.shape, env_ids.shape) == ((3,), (0,))
