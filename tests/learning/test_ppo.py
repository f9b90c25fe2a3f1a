"""rl_games' own PPO, on a cart that is pushed along a rail."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import mujoco
import pytest
import torch
from rl_games.algos_torch.a2c_continuous import A2CAgent
from torch import Tensor

from isaacgymenvs_lite.learning.ppo import PPOAgent
from isaacgymenvs_lite.registration import build_runner, register_env
from isaacgymenvs_lite.simulation.backend import make_simulation
from isaacgymenvs_lite.tasks.base.vec_task import VecTask

CART = """
<mujoco><option gravity="0 0 0" timestep="0.02"/><worldbody>
  <body name="cart"><joint name="rail" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body>
</worldbody><actuator><motor joint="rail" gear="10"/></actuator></mujoco>
"""
NUM_ENVS = 64
PARAMS: dict[str, Any] = {
    "seed": 7,
    "torch_threads": 2,
    "algo": {"name": "a2c_continuous"},
    "model": {"name": "continuous_a2c_logstd"},
    "network": {
        "name": "actor_critic",
        "separate": False,
        "space": {
            "continuous": {
                "mu_activation": "None",
                "sigma_activation": "None",
                "mu_init": {"name": "default"},
                "sigma_init": {"name": "const_initializer", "val": 0},
                "fixed_sigma": True,
            }
        },
        "mlp": {"units": [32, 16], "activation": "elu", "initializer": {"name": "default"}},
    },
    "config": {
        "name": "cart",
        "full_experiment_name": "cart",
        "env_name": "rlgpu",
        "device": "cpu",
        "device_name": "cpu",
        "num_actors": NUM_ENVS,
        "reward_shaper": {"scale_value": 1},
        "normalize_input": True,
        "normalize_value": True,
        "normalize_advantage": True,
        "value_bootstrap": True,
        "ppo": True,
        "gamma": 0.95,
        "tau": 0.95,
        "learning_rate": 3e-3,
        "lr_schedule": "constant",
        "grad_norm": 1.0,
        "entropy_coef": 0.0,
        "truncate_grads": True,
        "e_clip": 0.2,
        "clip_value": True,
        "horizon_length": 16,
        "minibatch_size": 512,
        "mini_epochs": 4,
        "critic_coef": 2,
        "bounds_loss_coef": 0.0001,
        "max_epochs": 12,
        "save_best_after": 1000,
        "print_stats": False,
    },
}


class Cart(VecTask):
    """Rewarded for staying near 1 m; starts at 0 and is reset after 32 steps."""

    def __init__(self) -> None:
        env = {"numEnvs": NUM_ENVS, "numObservations": 2, "numActions": 1, "clipActions": 1.0}
        config = {"name": "Cart", "env": env, "sim": {"dt": 0.02}}
        super().__init__(config, "cpu", "cpu", -1, True)
        self.max_episode_length = 33

    def create_sim(self) -> None:
        model = mujoco.MjModel.from_xml_string(CART)
        self.simulation = make_simulation(model, self.num_envs, 2, num_threads=1)

    def pre_physics_step(self, actions: Tensor) -> None:
        self.simulation.set_controls(actions)

    def post_physics_step(self) -> None:
        self.progress_buf += 1
        done_ids = self.reset_buf.nonzero().flatten()
        if len(done_ids) > 0:
            self.reset_idx(done_ids)
        self.obs_buf[:] = torch.cat((self.simulation.dof_pos, self.simulation.dof_vel), dim=-1)
        self.rew_buf[:] = -(self.simulation.dof_pos[:, 0] - 1.0).abs()
        self.reset_buf[:] = (self.progress_buf >= self.max_episode_length - 1).long()

    def reset_idx(self, env_ids: Tensor) -> None:
        zeros = torch.zeros(len(env_ids), 1)
        self.simulation.write_state(env_ids, torch.zeros(len(env_ids), 13), zeros, zeros)
        self.progress_buf[env_ids] = 0
        self.reset_buf[env_ids] = 0


@pytest.fixture
def make_agent(tmp_path):
    tasks: list[Cart] = []

    def make(cls: type | None = None, **config: Any) -> Any:
        tasks.append(Cart())
        register_env(lambda **kwargs: tasks[-1])
        params = copy.deepcopy(PARAMS)
        params["config"] |= {"train_dir": str(tmp_path), **config}
        runner = build_runner()
        runner.load({"params": params})
        if cls is not None:
            return cls("run", runner.params)
        return runner.algo_factory.create("a2c_continuous", base_name="run", params=runner.params)

    before = torch.get_num_threads()
    yield make
    torch.set_num_threads(before)
    register_env()
    for task in tasks:
        task.close()


def one_epoch(agent: Any) -> dict[str, Tensor]:
    torch.manual_seed(11)
    agent.init_tensors()
    agent.obs = agent.env_reset()
    agent.epoch_num = 1
    agent.train_epoch()
    agent.writer.close()
    return {name: value.clone() for name, value in agent.model.state_dict().items()}


def test_it_learns_what_rl_games_own_agent_learns(make_agent):
    ours, theirs = make_agent(), make_agent(A2CAgent)
    assert type(ours) is PPOAgent
    ours.model.load_state_dict(theirs.model.state_dict())
    first, second = one_epoch(ours), one_epoch(theirs)
    assert first.keys() == second.keys()
    for name, value in second.items():
        # eight steps of Adam apart by the rounding of sums only
        torch.testing.assert_close(first[name], value, rtol=1e-3, atol=1e-4, msg=name)


@pytest.mark.usefixtures("bfloat16")
def test_its_networks_are_evaluated_in_bfloat16_and_small_ones_whole(make_agent):
    agent = make_agent(mixed_precision=True)
    rows, dtypes = [], []

    def note(module: Any, args: Any, output: Tensor) -> None:
        rows.append(len(output))
        dtypes.append(output.dtype)

    agent.model.a2c_network.value.register_forward_hook(note)
    one_epoch(agent)
    assert set(rows) == {NUM_ENVS, 512}  # of a step, and of a minibatch
    assert set(dtypes) == {torch.bfloat16}


def test_the_cart_learns_to_go_where_it_is_rewarded(make_agent):
    agent = make_agent()
    rewards = []
    finish = agent.write_stats

    def note(*args: Any) -> None:
        if agent.game_rewards.current_size > 0:
            rewards.append(agent.game_rewards.get_mean()[0].item())
        finish(*args)

    agent.write_stats = note
    agent.train()
    # standing still is worth -32 in 32 steps
    assert rewards[0] < -20.0
    assert rewards[-1] > rewards[0] + 5.0


def test_isaac_labs_clip_actions_is_the_range_of_actions(
    make_classic_agent: Callable[..., Any],
) -> None:
    limit = "+train.params.env={clip_actions: 0.25}"
    agent = make_classic_agent("task=Ant", "num_envs=4", "max_iterations=1", limit)
    actions = torch.tensor([[-3.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 0.25]])
    expected = 0.25 * actions.clamp(-1, 1)  # rl_games: rescale_actions(low, high, clamped)
    scaled = torch.as_tensor(agent.preprocess_actions(actions))
    torch.testing.assert_close(scaled, expected)
