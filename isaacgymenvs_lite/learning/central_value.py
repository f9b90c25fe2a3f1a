"""The asymmetric critic: rl_games' central value net, which agents of both kinds have.

It observes the privileged `states` of a task, has an optimiser of its own, and its values take the
place of those that the policy's network returns.
"""

from __future__ import annotations

from typing import Any

import torch
from rl_games.algos_torch.central_value import CentralValueTrain

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.cpu.parallel import NetworkExecutor, parallelize
from isaacgymenvs_lite.learning.modules.running_mean_std import replace_normalizers


def make_central_value(agent: Any) -> CentralValueTrain:
    """Return the asymmetric critic of an agent, as the constructor of rl_games' A2CAgent makes it.

    Args:
        agent: whose `central_value_config` has the settings; its sizes and its writer exist.

    Raises:
        ConfigError: a recurrent one.
    """
    settings = agent.central_value_config
    critic = CentralValueTrain(
        state_shape=agent.state_shape,
        value_size=agent.value_size,
        ppo_device=agent.ppo_device,
        num_agents=agent.num_agents,
        horizon_length=agent.horizon_length,
        num_actors=agent.num_actors,
        num_actions=agent.actions_num,
        seq_length=agent.seq_length,
        normalize_value=agent.normalize_value,
        network=settings["network"],
        config=settings,
        writter=agent.writer,
        max_epochs=agent.max_epochs,
        multi_gpu=agent.multi_gpu,
        zero_rnn_on_done=agent.zero_rnn_on_done,
    )
    if critic.is_rnn:
        raise ConfigError(
            "train.params.config.central_value_config.network.rnn is not supported by AMP-family"
            " agents; remove it"
        )
    return critic.to(agent.ppo_device)


def take_models(agent: Any, device: str | torch.device, precision: Any) -> NetworkExecutor:
    """Give the models of an agent, its policy's and its critic's, fast normalisers and networks.

    Sets `value_mean_std`, which normalises the values of the critic that counts.

    Args:
        agent: its models are changed.
        device: where they are.
        precision: the key `train.params.config.mixed_precision`.

    Returns:
        what evaluates the policy's network.

    Raises:
        ConfigError: mixed_precision is none of True, False, "auto".
    """
    models = [agent.model]
    if agent.has_central_value:
        models.append(agent.central_value_net.model)
    executors = []
    for model in models:
        replace_normalizers(model)
        executors.append(parallelize(model, device, precision))
    if agent.normalize_value:
        agent.value_mean_std = models[-1].value_mean_std
    return executors[0]
