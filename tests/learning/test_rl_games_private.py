"""What this project needs of rl_games beyond its interface: a new version may move it.

rl_games has few underscores; these are the methods that are overridden, the steps of loops that are
its own, and the attributes that it sets. Other tests use them; this one names them all.
"""

from __future__ import annotations

import inspect
from typing import Any

import pytest
from rl_games import torch_runner
from rl_games.algos_torch import central_value, running_mean_std, sac_agent, torch_ext
from rl_games.algos_torch.a2c_continuous import A2CAgent
from rl_games.common import a2c_common, algo_observer, datasets, experience, player

# Who -> what it has to have.
MEMBERS: dict[Any, str] = {
    torch_runner: "Runner _override_sigma",
    a2c_common: "ContinuousA2CBase swap_and_flatten01",
    A2CAgent: """
        calc_gradients discount_values discount_values_masks env_reset env_step get_action_values
        get_full_state_weights get_stats_weights init_rnn_from_model init_tensors load_networks
        play_steps prepare_dataset restore restore_central_value_function save set_eval
        set_full_state_weights set_stats_weights set_train trancate_gradients_and_step
        train_actor_critic train_epoch update_epoch update_lr write_stats""",
    central_value.CentralValueTrain: "update_lr train_net calc_gradients",
    running_mean_std.RunningMeanStd: "_update_mean_var_count_from_moments",
    torch_ext: "mean_list policy_kl AverageMeter",
    sac_agent.SACAgent: "train_epoch env_step get_full_state_weights",
    player.BasePlayer: "get_action get_batch_size run reset",
    experience.VectorizedReplayBuffer: "add sample",
    datasets.PPODataset: "update_values_dict update_mu_sigma",
    algo_observer.AlgoObserver: """
        before_init after_init process_infos after_steps after_print_stats""",
}
# A function -> texts of its source that show what it does.
STEPS: dict[Any, tuple[str, ...]] = {
    # of several processes: gradients, learning rate, KL, frames and the end
    A2CAgent.trancate_gradients_and_step: ("self.multi_gpu", "all_reduce", "self.world_size"),
    A2CAgent.update_lr: ("self.multi_gpu", "broadcast"),
    central_value.CentralValueTrain.calc_gradients: ("self.multi_gpu", "self.world_size"),
    a2c_common.ContinuousA2CBase.train_epoch: ("self.schedule_type == 'legacy'", "all_reduce"),
    a2c_common.ContinuousA2CBase.train: (
        *("self.update_epoch()", "self.global_rank == 0", "self.world_size", "should_exit"),
        *("self.save_freq", "self.max_epochs", "self.max_frames", "self.write_stats("),
    ),
    a2c_common.A2CBase.__init__: ("self.writer = None", "init_process_group", "self.global_rank"),
    torch_runner.Runner.load_config: ("torch_threads", "torch.manual_seed"),
}


@pytest.mark.parametrize("owner", MEMBERS, ids=lambda owner: owner.__name__)
def test_members_are_there(owner):
    assert not [name for name in MEMBERS[owner].split() if not hasattr(owner, name)]


@pytest.mark.parametrize("function", STEPS, ids=lambda function: function.__qualname__)
def test_steps_are_those_that_agents_count_on(function):
    source = inspect.getsource(function)
    assert not [step for step in STEPS[function] if step not in source]
