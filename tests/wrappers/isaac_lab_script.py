"""A training script with the steps of Isaac Lab's tutorial for Stable-Baselines3, in our words.

Usage: isaac_lab_script.py TASK FOLDER
"""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import yaml
from omegaconf import OmegaConf
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CheckpointCallback, LogEveryNTimesteps
from stable_baselines3.common.vec_env import VecNormalize

import isaacgymenvs_lite  # noqa: F401  registers the tasks
from isaacgymenvs_lite.config.compose import compose_task
from isaacgymenvs_lite.wrappers import RecordVideo
from isaacgymenvs_lite.wrappers.sb3 import Sb3VecEnvWrapper, process_sb3_cfg

NUM_ENVS = 4
AGENT = """
seed: 3
n_timesteps: 96
policy: MlpPolicy
n_steps: 8
n_minibatches: 2
gamma: 0.98
n_epochs: 2
learning_rate: lin_3e-4
clip_range: 0.2
policy_kwargs: "dict(activation_fn=nn.ELU, net_arch=[8, 8], squash_output=False)"
device: cuda:0
normalize_input: True
normalize_value: True
clip_obs: 20.0
"""


def main(task: str, folder: Path) -> None:
    agent_cfg = yaml.safe_load(AGENT)
    env_cfg = compose_task(task, [f"num_envs={NUM_ENVS}", f"seed={agent_cfg['seed']}"])
    OmegaConf.save(env_cfg, folder / "env.yaml")
    agent_cfg = process_sb3_cfg(agent_cfg, NUM_ENVS)
    policy = agent_cfg.pop("policy")
    steps = agent_cfg.pop("n_timesteps")
    normalizer = {key: agent_cfg.pop(key) for key in ("normalize_input", "normalize_value")}
    clip_obs = agent_cfg.pop("clip_obs")

    env = gym.make(f"Isaac-{task}-v0", cfg=env_cfg, render_mode="rgb_array")
    env = RecordVideo(
        env,
        video_folder=str(folder / "videos"),
        step_trigger=lambda step: step % 10 == 0,
        video_length=5,
        disable_logger=True,
    )
    env = Sb3VecEnvWrapper(env, fast_variant=False)
    env = VecNormalize(
        env,
        norm_obs=normalizer["normalize_input"],
        norm_reward=normalizer["normalize_value"],
        clip_obs=clip_obs,
        gamma=agent_cfg["gamma"],
        clip_reward=np.inf,
    )
    agent = PPO(policy, env, verbose=1, tensorboard_log=str(folder), **agent_cfg)
    callbacks = [
        CheckpointCallback(save_freq=8, save_path=str(folder), name_prefix="model"),
        LogEveryNTimesteps(n_steps=32),
    ]
    agent.learn(total_timesteps=steps, callback=callbacks, log_interval=None)
    agent.save(folder / "model")
    env.save(str(folder / "model_vecnormalize.pkl"))
    env.close()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
