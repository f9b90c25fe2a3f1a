"""The life cycle of a task, on a cart that is pushed along a rail."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.simulation.backend import make_simulation
from isaacgymenvs_lite.tasks.base.mjcf_task import MjcfTask
from isaacgymenvs_lite.tasks.base.vec_task import Done, VecTask

CART = """
<mujoco><option gravity="0 0 0"/><worldbody>
  <body name="cart"><joint name="rail" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body>
</worldbody><actuator><motor joint="rail"/></actuator></mujoco>
"""
DT, SUBSTEPS, FREQUENCY_INV = 0.02, 2, 3
EPISODE_LENGTH = 5
# How far one control step under 1 N moves a cart at rest: six physics steps of h = 0.01 s,
# F / m h^2 (1 + ... + 6).
FIRST_MOVE_M = 0.5 * 1e-4 * 21
FIRST_SPEED = 0.5 * 0.06


class PushedCart(VecTask):
    """A task in the way of IsaacGymEnvs, which the test may let fail: it observes a cart."""

    def __init__(self, config: dict[str, Any], **arguments: Any) -> None:
        self.resets: list[list[int]] = []
        self.fail = torch.zeros(max(config["env"].get("numEnvs", 0), 0), dtype=torch.bool)
        self.given_actions: list[Tensor] = []
        defaults = {
            "rl_device": "cpu",
            "sim_device": "cpu",
            "graphics_device_id": 0,
            "headless": True,
        }
        super().__init__(config, **{**defaults, **arguments})
        self.max_episode_length = EPISODE_LENGTH

    def create_sim(self) -> None:
        model = mujoco.MjModel.from_xml_string(CART)
        model.opt.timestep = self.dt / SUBSTEPS
        self.simulation = make_simulation(
            model, self.num_envs, SUBSTEPS * self.control_freq_inv, num_threads=1
        )

    def pre_physics_step(self, actions: Tensor) -> None:
        self.given_actions.append(actions)
        self.simulation.set_controls(actions)

    def post_physics_step(self) -> None:
        self.progress_buf += 1
        self.obs_buf[:] = torch.cat((self.simulation.dof_pos, self.simulation.dof_vel), dim=-1)
        if self.num_states > 0:
            self.states_buf[:] = 100.0 * self.obs_buf[:, :1]
        self.rew_buf[:] = self.simulation.dof_pos[:, 0]
        at_limit = self.progress_buf >= self.max_episode_length - 1
        self.reset_buf[:] = (at_limit | self.fail).long()

    def compute_failures(self) -> Tensor:
        return self.fail

    def reset_idx(self, env_ids: Tensor) -> None:
        self.resets.append(env_ids.tolist())
        n = len(env_ids)
        zeros = torch.zeros(n, 1)
        self.simulation.write_state(env_ids, torch.zeros(n, 13), zeros, zeros)
        self.progress_buf[env_ids] = 0
        self.reset_buf[env_ids] = 0
        self.obs_buf[env_ids] = 0.0


MakeCart = Callable[..., PushedCart]


def _config(**env: Any) -> dict[str, Any]:
    return {
        "name": "PushedCart",
        "physics_engine": "physx",
        "env": {
            "numEnvs": 3,
            "numObservations": 2,
            "numActions": 1,
            "controlFrequencyInv": FREQUENCY_INV,
            **env,
        },
        "sim": {"dt": DT, "substeps": SUBSTEPS, "up_axis": "z", "use_gpu_pipeline": False},
    }


@pytest.fixture
def make_cart() -> Iterator[MakeCart]:
    made: list[PushedCart] = []

    def make(arguments: dict[str, Any] | None = None, **env: Any) -> PushedCart:
        made.append(PushedCart(_config(**env), **(arguments or {})))
        return made[-1]

    yield make
    for task in made:
        task.close()


def _push(task: PushedCart, force: float = 1.0) -> tuple[Tensor, Tensor, Tensor, dict[str, Any]]:
    observations, rewards, dones, infos = task.step(torch.full((task.num_envs, 1), force))
    return observations["obs"], rewards, dones, infos


# --- making -----------------------------------------------------------------------------------


def test_sizes_spaces_and_first_buffers(make_cart: MakeCart) -> None:
    cart = make_cart(numStates=4)
    assert (cart.num_envs, cart.num_environments) == (3, 3)
    assert (cart.num_obs, cart.num_observations) == (2, 2)
    assert (cart.num_acts, cart.num_actions, cart.num_states, cart.num_agents) == (1, 1, 4, 1)
    assert cart.control_freq_inv == FREQUENCY_INV
    assert cart.dt == DT
    unbounded = {
        size: gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32) for size in (2, 4)
    }
    assert cart.observation_space == cart.obs_space == unbounded[2]
    assert cart.state_space == unbounded[4]
    assert cart.action_space == gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    buffers = {
        "obs_buf": ((3, 2), torch.float32, 0),
        "states_buf": ((3, 4), torch.float32, 0),
        "rew_buf": ((3,), torch.float32, 0),
        "reset_buf": ((3,), torch.int64, 1),  # every environment starts with a reset
        "timeout_buf": ((3,), torch.bool, 0),
        "progress_buf": ((3,), torch.int64, 0),
        "randomize_buf": ((3,), torch.int64, 0),
    }
    for name, (shape, dtype, value) in buffers.items():
        buffer = getattr(cart, name)
        assert (tuple(buffer.shape), buffer.dtype) == (shape, dtype), name
        assert (buffer == value).all(), name


def test_no_environments() -> None:
    for num_envs in [0, -1]:
        with pytest.raises(
            ConfigError, match=rf"numEnvs: got {num_envs}, expected a whole number of"
        ):
            PushedCart(_config(numEnvs=num_envs))


# --- devices ----------------------------------------------------------------------------------


def test_physics_stays_on_the_cpu_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    for sim_device, gpu_pipeline in [("cuda:0", True), ("cpu", True), ("cuda:1", False)]:
        config = _config()
        config["sim"]["use_gpu_pipeline"] = gpu_pipeline
        with caplog.at_level(logging.INFO):
            cart = PushedCart(config, sim_device=sim_device)
        assert cart.device == torch.device("cpu")
        assert any(f"sim_device={sim_device}" in message for message in caplog.messages)
        cart.close()


def test_what_a_step_returns_lies_on_the_rl_device(make_cart: MakeCart) -> None:
    # torch's `meta` device has no data and needs no hardware.
    cart = make_cart({"rl_device": "meta"}, numStates=1)
    observations, rewards, dones, infos = cart.step(torch.zeros(3, 1))
    after_reset, done_ids = cart.reset_done()
    returned = {
        "obs": observations["obs"],
        "states": observations["states"],
        "rewards": rewards,
        "dones": dones,
        "time_outs": infos["time_outs"],
        "obs after reset_done": after_reset["obs"],
        "done_ids": done_ids,
        "reset": cart.reset()["obs"],
        "zero_actions": cart.zero_actions(),
        "get_state": cart.get_state(),
    }
    for name, tensor in returned.items():
        assert tensor.device.type == "meta", name
    assert cart.obs_buf.device.type == "cpu"


# --- a step -----------------------------------------------------------------------------------


def test_a_control_step_simulates_its_time(make_cart: MakeCart) -> None:
    cart = make_cart()
    observed, rewards, dones, _ = _push(cart)
    expected = torch.tensor([FIRST_MOVE_M, FIRST_SPEED]).expand(3, 2)
    torch.testing.assert_close(observed, expected, rtol=1e-5, atol=0.0)
    _close(rewards, FIRST_MOVE_M)
    assert (rewards.dtype, dones.dtype) == (torch.float32, torch.int64)


def test_actions_are_clamped(make_cart: MakeCart) -> None:
    cart = make_cart(clipActions=0.5)
    given = torch.tensor([[7.0], [-7.0], [0.25]])
    cart.step(given)
    assert cart.given_actions[0].tolist() == [[0.5], [-0.5], [0.25]]
    assert given.tolist() == [[7.0], [-7.0], [0.25]]  # the caller's tensor is left alone
    free = make_cart()
    free.step(given)
    assert free.given_actions[0].tolist() == given.tolist()


def test_observations_are_clamped_but_not_their_buffer(make_cart: MakeCart) -> None:
    cart = make_cart(clipObservations=0.01, numStates=1)
    observations, *_ = cart.step(torch.tensor([[1.0], [-1.0], [0.0]]))
    expected = [[FIRST_MOVE_M, 0.01], [-FIRST_MOVE_M, -0.01], [0.0, 0.0]]
    torch.testing.assert_close(observations["obs"], torch.tensor(expected), rtol=1e-5, atol=1e-8)
    assert observations["states"].tolist() == pytest.approx(np.array([[0.01], [-0.01], [0.0]]))
    assert torch.equal(cart.get_state(), observations["states"])
    _close(cart.obs_buf[0, 1], FIRST_SPEED)
    _close(cart.states_buf[0, 0], 100.0 * FIRST_MOVE_M)


def test_what_a_step_returned_is_not_touched_by_the_next(make_cart: MakeCart) -> None:
    cart = make_cart()
    observed, rewards, dones, infos = _push(cart)
    time_outs = infos["time_outs"]
    kept = [tensor.clone() for tensor in (observed, rewards, dones, time_outs)]
    for _ in range(EPISODE_LENGTH - 2):
        _push(cart)
    assert cart.reset_buf.all()
    for tensor, copy in zip((observed, rewards, dones, time_outs), kept, strict=True):
        assert torch.equal(tensor, copy)
    # nor does a caller who writes into it write into the task
    observed, rewards, dones, _ = _push(cart)
    for tensor in (observed, rewards, dones):
        tensor.fill_(77)
    for buffer in (cart.obs_buf, cart.rew_buf, cart.reset_buf):
        assert not (buffer == 77).any()


# --- ends of episodes -------------------------------------------------------------------------


def test_time_outs_at_the_limit_only(make_cart: MakeCart) -> None:
    cart = make_cart()
    cart.reset_done()
    for step in range(1, EPISODE_LENGTH):
        *_, dones, infos = _push(cart)
        at_limit = step == EPISODE_LENGTH - 1
        assert dones.tolist() == [int(at_limit)] * 3
        assert infos["time_outs"].tolist() == [at_limit] * 3
        assert infos["time_outs"].dtype == torch.bool


def test_a_failure_is_no_time_out(make_cart: MakeCart) -> None:
    cart = make_cart()
    cart.reset_done()
    cart.fail[1] = True
    *_, dones, infos = _push(cart)
    assert dones.tolist() == [0, 1, 0]
    assert infos["time_outs"].tolist() == [False] * 3
    cart.fail[1] = False
    for _ in range(EPISODE_LENGTH - 3):
        _push(cart)
    # In the last step the first cart fails, the others only run out of time.
    cart.fail[0] = True
    *_, dones, infos = _push(cart)
    assert dones.tolist() == [1, 1, 1]
    assert infos["time_outs"].tolist() == [False, True, True]


def test_an_end_before_the_limit_is_a_failure(make_cart: MakeCart) -> None:
    # A task of IsaacGymEnvs writes `reset_buf` and gives no reason.
    class Reckless(PushedCart):
        def post_physics_step(self) -> None:
            super().post_physics_step()
            self.reset_buf[0] = 1

    cart = Reckless(_config())
    cart.reset_done()
    *_, dones, infos = _push(cart)
    assert dones.tolist() == [1, 0, 0]
    assert not infos["time_outs"].any()
    assert cart.done_buf.tolist() == [Done.FAILED, Done.RUNNING, Done.RUNNING]
    cart.close()


def test_reset_resets_nothing(make_cart: MakeCart) -> None:
    cart = make_cart()
    assert cart.reset()["obs"].tolist() == [[0.0, 0.0]] * 3
    assert cart.reset_buf.tolist() == [1, 1, 1]
    _push(cart)
    _close(cart.reset()["obs"][:, 1], FIRST_SPEED)
    assert cart.resets == []


def test_reset_done_resets_what_is_done(make_cart: MakeCart) -> None:
    cart = make_cart()
    observations, done_ids = cart.reset_done()
    assert done_ids.tolist() == [0, 1, 2]  # at the start all
    cart.fail[1] = True
    _push(cart)
    observations, done_ids = cart.reset_done()
    assert done_ids.tolist() == [1]
    assert torch.equal(cart.progress_buf, torch.tensor([1, 0, 1]))
    _close(observations["obs"][:, 1], [FIRST_SPEED, 0.0, FIRST_SPEED])
    assert cart.resets == [[0, 1, 2], [1]]
    # Nobody is done now.
    _, done_ids = cart.reset_done()
    assert done_ids.tolist() == []
    assert cart.resets == [[0, 1, 2], [1]]


# --- the life cycle, once for all modes -------------------------------------------------------


class LivelyCart(MjcfTask):
    """Fills in the methods of a task of this project; writes down their order."""

    num_observations = 2
    num_actions = 1

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.events: list[str] = []
        self.fail = torch.zeros(3, dtype=torch.bool)
        super().__init__(*args, **kwargs)

    def episode_length(self) -> int:
        return EPISODE_LENGTH

    def build_model(self) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_string(CART)

    def compute_controls(self, actions: Tensor) -> Tensor:
        self.events.append(f"controls {actions.flatten().tolist()}")
        return actions

    def update_state(self) -> None:
        self.events.append("state")

    def compute_obs(self) -> Tensor:
        self.events.append("observe")
        return torch.cat((self.simulation.dof_pos, self.simulation.dof_vel), dim=-1)

    def compute_reward_terms(self) -> dict[str, Tensor]:
        self.events.append("reward")
        return {"forwards": self.simulation.dof_vel[:, 0], "alive": torch.ones(3)}

    def compute_failures(self) -> Tensor:
        self.events.append("failures")
        return self.fail

    def reset_state(self, env_ids: Tensor) -> None:
        self.events.append(f"reset {env_ids.tolist()}")
        n = len(env_ids)
        self.simulation.write_state(
            env_ids, torch.zeros(n, 13), torch.zeros(n, 1), torch.zeros(n, 1)
        )


@pytest.fixture
def make_lively() -> Iterator[Callable[..., LivelyCart]]:
    """Return `make_lively(**attributes)`, whose environment 1 fails in its first step."""
    made: list[LivelyCart] = []

    def make(**attributes: Any) -> LivelyCart:
        cls = type("Cart", (LivelyCart,), attributes)
        cart = cls({"env": {"numEnvs": 3}, "sim": {"dt": DT}}, "cpu", "cpu", -1, True)
        made.append(cart)
        cart.reset()
        cart.fail[1] = True
        cart.events.clear()
        return cart

    yield make
    for task in made:
        task.close()


ALL_IN_ORDER = ["state", "observe", "reward", "failures"]


@pytest.mark.parametrize(
    ("starts_before_physics", "second"),
    [
        (True, ["reset [1]", "controls [1.0, 1.0, 1.0]", *ALL_IN_ORDER]),
        (False, ["controls [1.0, 1.0, 1.0]", "reset [1]", *ALL_IN_ORDER]),
    ],
)
def test_order_of_a_life(make_lively, starts_before_physics: bool, second: list[str]) -> None:
    cart = make_lively(starts_before_physics=starts_before_physics)
    observed, rewards, dones, infos = _push(cart)
    assert cart.events == ["controls [1.0, 1.0, 1.0]", *ALL_IN_ORDER]
    assert dones.tolist() == [0, 1, 0]
    assert infos["time_outs"].tolist() == [False] * 3
    assert cart.done_buf.tolist() == [Done.RUNNING, Done.FAILED, Done.RUNNING]
    assert (rewards > 1.0).all()  # alive, and moving at the end of its last step
    assert (observed[1] != 0.0).all()  # the last observation
    assert cart.reset_buf.tolist() == [0, 1, 0]
    cart.fail[1] = False
    cart.events.clear()
    observed, _, dones, _ = _push(cart)
    assert cart.events == second
    assert dones.tolist() == [0, 0, 0]
    assert (cart.done_buf == Done.RUNNING).all()
    assert cart.progress_buf.tolist() == [2, int(starts_before_physics), 2]


@pytest.mark.parametrize("starts_before_physics", [True, False])
def test_an_episode_starts_earlier_by_reset_done(make_lively, starts_before_physics: bool) -> None:
    cart = make_lively(starts_before_physics=starts_before_physics)
    last, *_ = _push(cart)
    cart.events.clear()
    first, env_ids = cart.reset_done()
    assert cart.events == ["reset [1]", "observe"]
    assert env_ids.tolist() == [1]
    assert (first["obs"][1] == 0.0).all()
    assert torch.equal(first["obs"][[0, 2]], last[[0, 2]])
    assert (cart.done_buf == Done.RUNNING).all()
    cart.fail[1] = False
    _push(cart)
    assert cart.progress_buf.tolist() == [2, 1, 2]


# --- hooks of trainers ------------------------------------------------------------------------


@pytest.mark.usefixtures("gl")
def test_a_picture_is_drawn_of_the_present_state(make_cart: MakeCart) -> None:
    cart = make_cart()
    first = cart.render()
    assert first is not None
    assert (first.shape, first.dtype) == ((480, 640, 3), np.uint8)
    assert first.std() > 1.0  # something is to be seen
    np.testing.assert_array_equal(cart.render(mode="rgb_array"), first)
    for _ in range(EPISODE_LENGTH):
        _push(cart, 1000.0)
    assert (cart.render() != first).any()


def _close(actual: Tensor, expected: float | list[float]) -> None:
    wanted = torch.as_tensor(expected).expand_as(actual)
    torch.testing.assert_close(actual, wanted, rtol=1e-5, atol=1e-8)
