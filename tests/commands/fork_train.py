"""A train script as forks of IsaacGymEnvs have: its imports and calls in their order, our words.

Not a test: `test_alias` runs it through the alias, in a folder with a cfg/ of its own.
"""

import os
from datetime import datetime

import gym
import hydra
import isaacgym  # noqa: F401  before torch, as Isaac Gym wanted
from hydra.utils import to_absolute_path
from isaacgymenvs.pbt.pbt import PbtAlgoObserver, initial_pbt_check
from isaacgymenvs.tasks import isaacgym_task_map
from isaacgymenvs.utils.reformat import omegaconf_to_dict, print_dict
from isaacgymenvs.utils.rlgames_utils import multi_gpu_get_rank  # noqa: F401
from isaacgymenvs.utils.utils import set_np_formatting, set_seed
from omegaconf import DictConfig, OmegaConf


def complete(cfg: DictConfig, section: dict) -> dict:
    section["params"]["config"].update(
        device=cfg.rl_device,
        population_based_training=cfg.pbt.enabled,
        pbt_idx=cfg.pbt.policy_idx if cfg.pbt.enabled else None,
        full_experiment_name=cfg.get("full_experiment_name"),
    )
    return section


@hydra.main(version_base="1.1", config_name="config", config_path="./cfg")
def launch(cfg: DictConfig) -> None:
    if cfg.pbt.enabled:
        initial_pbt_check(cfg)

    import isaacgymenvs
    from isaacgymenvs.learning import (
        amp_continuous,
        amp_models,
        amp_network_builder,
        amp_players,
    )
    from isaacgymenvs.utils.rlgames_utils import (
        ComplexObsRLGPUEnv,
        MultiObserver,
        RLGPUAlgoObserver,
        RLGPUEnv,
    )
    from isaacgymenvs.utils.wandb_utils import WandbAlgoObserver
    from rl_games.algos_torch import model_builder
    from rl_games.common import env_configurations, vecenv
    from rl_games.torch_runner import Runner

    if cfg.checkpoint:
        cfg.checkpoint = to_absolute_path(cfg.checkpoint)
    print_dict(omegaconf_to_dict(cfg))
    set_np_formatting()
    rank = int(os.getenv("RANK", "0"))
    cfg.seed = set_seed(cfg.seed, torch_deterministic=cfg.torch_deterministic, rank=rank)

    def make(**kwargs):
        where = (cfg.sim_device, cfg.rl_device, cfg.graphics_device_id, cfg.headless)
        how = (cfg.multi_gpu, cfg.capture_video, cfg.force_render)
        envs = isaacgymenvs.make(
            cfg.seed, cfg.task_name, cfg.task.env.numEnvs, *where, *how, cfg, **kwargs
        )
        if cfg.capture_video:
            envs.is_vector_env = True
            envs = gym.wrappers.RecordVideo(
                envs,
                f"videos/{cfg.wandb_name}",
                step_trigger=lambda step: step % cfg.capture_video_freq == 0,
                video_length=cfg.capture_video_len,
            )
        return envs

    env_configurations.register(
        "rlgpu", {"vecenv_type": "RLGPU", "env_creator": lambda **kwargs: make(**kwargs)}
    )
    if getattr(isaacgym_task_map[cfg.task_name], "dict_obs_cls", False):
        inputs = list(cfg.train.params.network.inputs)
        spec = {"obs": {"names": inputs, "concat": True, "space_name": "observation_space"}}
        vecenv.register("RLGPU", lambda name, n, **kw: ComplexObsRLGPUEnv(name, n, spec, **kw))
    else:
        vecenv.register("RLGPU", lambda name, n, **kw: RLGPUEnv(name, n, **kw))

    section = complete(cfg, omegaconf_to_dict(cfg.train))
    observers = [RLGPUAlgoObserver()]
    if cfg.pbt.enabled:
        observers.append(PbtAlgoObserver(cfg))
    if cfg.wandb_activate:
        observers.append(WandbAlgoObserver(cfg))

    def build_runner(observer):
        runner = Runner(observer)
        runner.algo_factory.register_builder(
            "amp_continuous", lambda **kwargs: amp_continuous.AMPAgent(**kwargs)
        )
        runner.player_factory.register_builder(
            "amp_continuous", lambda **kwargs: amp_players.AMPPlayerContinuous(**kwargs)
        )
        model_builder.register_model(
            "continuous_amp", lambda network, **kwargs: amp_models.ModelAMPContinuous(network)
        )
        model_builder.register_network("amp", lambda **kwargs: amp_network_builder.AMPBuilder())
        return runner

    runner = build_runner(MultiObserver(observers))
    runner.load(section)
    runner.reset()
    if not cfg.test:
        folder = f"runs/{cfg.train.params.config.name}{datetime.now():_%d-%H-%M-%S}"
        os.makedirs(folder, exist_ok=True)
        with open(os.path.join(folder, "config.yaml"), "w") as file:
            file.write(OmegaConf.to_yaml(cfg))
    runner.run(
        {
            "train": not cfg.test,
            "play": cfg.test,
            "checkpoint": cfg.checkpoint,
            "sigma": cfg.sigma if cfg.sigma != "" else None,
        }
    )


if __name__ == "__main__":
    launch()
