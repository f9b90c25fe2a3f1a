"""AnymalTerrain: its drives, its ground, what happens to robots from step to step."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.paths import assets_dir
from isaacgymenvs_lite.tasks.anymal_terrain_terms import TERM_NAMES
from isaacgymenvs_lite.utils.rotations import quat_from_euler_xyz

DEFAULT_ANGLES = [0.03, 0.4, -0.8, 0.03, -0.4, 0.8, -0.03, 0.4, -0.8, -0.03, -0.4, 0.8]
# Three levels of: a pit, flat at level 0; two stairs down; stairs up.
SMALL = (
    "task=AnymalTerrain",
    "task.env.terrain.numLevels=3",
    "task.env.terrain.numTerrains=4",
    "task.env.terrain.borderSize=2",
)
EXACT = ("task.env.learn.addNoise=False", "task.env.learn.pushRobots=False")


@pytest.fixture
def make(make_task):
    """Return `make(*overrides, num_envs=4, seed=0)`, robots on a small ground."""

    def small(*overrides: str, num_envs: int = 4, seed: int = 0):
        torch.manual_seed(seed)
        return make_task(*SMALL, *overrides, num_envs=num_envs)

    return small


def _all(task) -> torch.Tensor:
    return torch.arange(task.num_envs)


def _put(task, **where) -> None:
    """Write robots at their default angles; `where`: columns of the root state and their values."""
    columns = {"pos": slice(0, 3), "rot": slice(3, 7), "vel": slice(7, 13)}
    root = task.simulation.root_states.clone()
    for name, values in where.items():
        root[:, columns[name]] = torch.as_tensor(values, dtype=torch.float32)
    joints = torch.tensor(DEFAULT_ANGLES).repeat(task.num_envs, 1)
    task.simulation.write_state(_all(task), root, joints, torch.zeros_like(joints))


# --- drives and time ------------------------------------------------------------------------


def test_a_control_step_is_four_simulator_calls_of_5_ms(make) -> None:
    task = make()
    assert task.simulation.substeps == 4
    assert task.simulation.model.opt.timestep == pytest.approx(0.005)
    assert task.dt == pytest.approx(0.02)
    assert task.max_episode_length == 1000


def test_as_published_there_is_a_fifth_that_nothing_counts(make) -> None:
    task = make("task.env.control.extraSimulatorCall=True")
    assert task.simulation.substeps == 5
    assert task.dt == pytest.approx(0.02)
    assert task.max_episode_length == 1000


def test_torques_are_those_of_the_pd_formula(make) -> None:
    task = make("task.env.control.decimation=1", *EXACT, num_envs=16)
    task.reset()
    sim = task.simulation
    largest = 0.0
    for scale in (0.5, 0.5, 1.0, 3.0, 6.0):
        for _ in range(20):
            pos, vel = sim.dof_pos.clone(), sim.dof_vel.clone()
            actions = scale * torch.randn(16, 12)
            task.step(actions)
            running = task.progress_buf > 0
            target = 0.5 * actions + torch.tensor(DEFAULT_ANGLES)
            torques = (80.0 * (target - pos) - 2.0 * vel).clamp(-80.0, 80.0)
            # float32 positions of a rad, times 80.
            assert torch.allclose(sim.dof_forces[running], torques[running], atol=2e-4)
            largest = max(largest, torques.abs().max().item())
    assert largest == 80.0


def test_a_control_step_is_four_torques_at_5_ms_each(make) -> None:
    """The drives do what a controller does that computes the torque before each call."""
    task = make(*EXACT, num_envs=1)
    task.reset()
    sim = task.simulation
    model = mujoco.MjModel.from_xml_path(str(assets_dir() / task.own_asset))
    model.actuator_gainprm[:] = 0.0
    model.actuator_biasprm[:] = 0.0
    data = mujoco.MjData(model)
    # In the air, where the ground does not matter.
    data.qpos[2] = 5.0
    data.qpos[7:] = sim.dof_pos[0].double().numpy()
    data.qvel[6:] = sim.dof_vel[0].double().numpy()
    action = np.linspace(-1.0, 3.0, 12)
    clipped = False
    for _ in range(4):
        target = 0.5 * action + np.array(DEFAULT_ANGLES)
        torque = 80.0 * (target - data.qpos[7:]) - 2.0 * data.qvel[6:]
        data.qfrc_applied[6:] = torque.clip(-80.0, 80.0)
        clipped |= bool((np.abs(torque) > 80.0).any())
        mujoco.mj_step(model, data)
    task.step(torch.from_numpy(action).float()[None])
    # The action went there in float32.
    assert sim.dof_pos[0].tolist() == pytest.approx(data.qpos[7:].tolist(), abs=1e-6)
    assert sim.dof_vel[0].tolist() == pytest.approx(data.qvel[6:].tolist(), abs=1e-4)
    assert sim.dof_vel[0].abs().max() > 2.0
    assert clipped


# --- ground ---------------------------------------------------------------------------------


@pytest.mark.parametrize("level", [0, 2])
def test_robots_stand_on_their_tile(make, level: int) -> None:
    task = make(*EXACT, num_envs=32)
    task.curriculum.levels[:] = level
    task.reset()
    sim = task.simulation
    origins = task.curriculum.origins(_all(task))
    assert origins[:, 0].tolist() == pytest.approx([8.0 * level + 4.0] * 32)
    assert set(origins[:, 1].tolist()) == {4.0, 12.0, 20.0, 28.0}
    if level == 2:
        assert len(set(origins[:, 2].tolist())) == 3  # a pit, stairs down, stairs up
    offset = sim.root_states[:, :3] - origins
    assert offset[:, 2].tolist() == pytest.approx([0.62] * 32, abs=1e-5)
    assert 0.4 < offset[:, :2].abs().max() <= 0.5
    task.step(task.zero_actions())
    assert not sim.contact_forces.any()
    for _ in range(100):
        *_, dones, _ = task.step(task.zero_actions())
        assert not dones.any()
    above = sim.root_states[:, 2] - origins[:, 2]
    assert 0.42 < above.min() <= above.max() < 0.543
    weight = sim.contact_forces[:, 3::3, 2].sum(1)
    assert weight.median().item() == pytest.approx(53.164 * 9.81, rel=0.02)


def test_observed_heights_are_those_of_the_ground(make) -> None:
    task = make(*EXACT, num_envs=24)
    task.curriculum.levels[:] = torch.arange(24) % 3
    task.reset()
    spread = torch.rand(24, 2) * torch.tensor([22.0, 30.0]) + 1.0
    yaw = 6.0 * torch.rand(24)
    pos = torch.cat((spread, torch.full((24, 1), 0.7)), dim=1)
    rot = quat_from_euler_xyz(torch.zeros(24), torch.zeros(24), yaw)
    _put(task, pos=pos, rot=rot)
    heights = task.observe()[:, 36:176]
    samples = task.terrain.samples.astype(float)
    for env in range(24):
        cos, sin = math.cos(yaw[env]), math.sin(yaw[env])
        for place, (ahead, aside) in ((0, (-0.8, -0.5)), (9, (-0.8, 0.5)), (139, (0.8, 0.5))):
            x = (spread[env, 0].item() + cos * ahead - sin * aside + 2.0) / 0.1
            y = (spread[env, 1].item() + sin * ahead + cos * aside + 2.0) / 0.1
            if min(x % 1, y % 1, 1 - x % 1, 1 - y % 1) < 1e-3:
                continue  # on the border of two squares
            ground = 0.005 * min(samples[int(x), int(y)], samples[int(x) + 1, int(y) + 1])
            expected = 5.0 * max(-1.0, min(1.0, 0.7 - 0.5 - ground))
            assert heights[env, place].item() == pytest.approx(expected, abs=1e-4)
    assert heights.unique().numel() > 20


def test_a_plane_has_no_heights_and_no_levels(make) -> None:
    task = make("task.env.terrain.terrainType=plane", *EXACT)
    observed = task.reset()["obs"]
    assert task.simulation.model.nhfield == 0
    assert torch.allclose(observed[:, 36:176], torch.tensor(0.6), atol=1e-5)
    assert not task.curriculum.origins(_all(task)).any()
    task.progress_buf[:] = 998
    *_, infos = task.step(task.zero_actions())
    assert infos["episode"]["terrain_level"] == 0.0


def test_friction_of_the_ground(make) -> None:
    task = make("task.env.terrain.dynamicFriction=0.7")
    assert (task.simulation.model.geom_friction[:, 0] == 0.7).all()


def test_robots_differ_in_friction_which_is_averaged_with_the_grounds(make) -> None:
    task = make("task.env.learn.frictionRange=[0.5,1.25]", num_envs=150)
    model = task.simulation.model
    robot = np.flatnonzero(model.geom_bodyid > 0)
    friction = task.simulation.expand("geom_friction")[:, robot, 0]
    assert (friction == friction[:, :1]).all()  # all parts of a robot
    own = 2.0 * friction[:, 0] - 1.0
    assert own.min() >= 0.5
    assert own.max() <= 1.25
    assert len(np.unique(own[:100])) == 100
    assert (own[100:] == own[:50]).all()  # the buckets in turn
    # MuJoCo would take the larger of two coefficients, the ground's.
    floor = model.geom("floor").id
    assert task.simulation.expand("geom_friction")[:, floor, 0].max() < 1e-4
    same = make("task.env.learn.randomizeFriction=False")
    assert (same.simulation.model.geom_friction[:, 0] == 1.0).all()


def test_the_seed_decides_on_the_ground(make) -> None:
    kinds = ("task.env.terrain.terrainProportions=[0,0.5,0,0,0.5]",)

    def samples(seed: int) -> bytes:
        return make(*kinds, seed=seed).terrain.samples.tobytes()

    assert samples(1) == samples(1) != samples(2)


# --- commands -------------------------------------------------------------------------------


def test_commands_are_drawn_in_their_ranges_and_small_ones_are_none(make) -> None:
    task = make(num_envs=2000)
    task.reset()
    along, aside, _, heading = task.commands.unbind(-1)
    speed = torch.hypot(along, aside)
    none = speed == 0.0
    # A circle of 0.25 m/s within a square of 2 m/s: pi / 64 = 4.9 %.
    assert 0.03 < none.float().mean() < 0.07
    assert speed[~none].min() > 0.25
    assert not heading[none].any()
    for drawn, limit in ((along, 1.0), (aside, 1.0), (heading, 3.14)):
        assert -limit <= drawn.min() < -0.98 * limit
        assert 0.98 * limit < drawn.max() <= limit


@pytest.mark.parametrize(
    ("heading", "commanded", "rate"),
    [
        (0.0, 1.0, 0.5),
        (1.0, 0.0, -0.5),
        (0.0, 3.0, 1.0),
        (3.0, -3.0, (2 * math.pi - 6.0) / 2),  # over the back, the shorter way
        (-3.0, 3.0, -(2 * math.pi - 6.0) / 2),
    ],
)
def test_the_yaw_rate_leads_to_the_heading(make, heading, commanded, rate) -> None:
    task = make(*EXACT)
    task.reset()
    task.commands[:, 3] = commanded
    half = heading / 2
    _put(task, rot=[0.0, 0.0, math.sin(half), math.cos(half)], vel=0.0)
    task.advance()
    assert task.commands[:, 2].tolist() == pytest.approx([rate] * 4, abs=1e-5)
    assert task.observe()[:, 11].tolist() == pytest.approx([rate / 4] * 4, abs=1e-5)


# --- episodes -------------------------------------------------------------------------------


def test_the_step_that_ends_an_episode_returns_the_first_observation_of_the_next(make) -> None:
    task = make(*EXACT)
    task.reset()
    for _ in range(20):
        task.step(0.3 * torch.randn(4, 12))
    task.progress_buf[:] = torch.tensor([998, 5, 998, 5])
    commands = task.commands.clone()
    observed, _, dones, infos = task.step(0.3 * torch.randn(4, 12))
    assert dones.tolist() == infos["time_outs"].tolist() == [1, 0, 1, 0]
    assert task.progress_buf.tolist() == [0, 6, 0, 6]
    new = observed["obs"][[0, 2]]
    sim = task.simulation
    # At rest and upright, as the new state is: no velocity, gravity or heading of the last one.
    assert torch.allclose(new[:, :9], torch.tensor([0.0] * 8 + [-1.0]), atol=1e-6)
    assert (task.commands[[0, 2], 3] != commands[[0, 2], 3]).all()
    headings = task.commands[[0, 2], 3]
    assert torch.allclose(new[:, 11], 0.25 * (0.5 * headings).clamp(-1.0, 1.0), atol=1e-6)
    assert torch.equal(new[:, 12:24], sim.dof_pos[[0, 2]])
    assert (new[:, 36:176] > 0.55).all()
    assert not new[:, 176:].any()
    assert observed["obs"][[1, 3], 176:].any()
    # The next step is an ordinary one.
    *_, dones, infos = task.step(task.zero_actions())
    assert not dones.any()
    assert task.progress_buf.tolist() == [1, 7, 1, 7]


def test_the_first_step_of_a_new_episode_has_no_memory_of_the_last(make) -> None:
    task = make(*EXACT)
    task.reset()
    for _ in range(20):
        task.step(torch.randn(4, 12))
    task.progress_buf[:] = 998
    task.step(torch.full((4, 12), 3.0))
    start_vel = task.simulation.dof_vel.clone()
    task.step(task.zero_actions())
    assert not task.reward_terms["action_rate"].any()
    changes = (task.simulation.dof_vel - start_vel).square().sum(1)
    assert torch.allclose(task.reward_terms["joint_acc"], -0.0005 * 0.02 * changes)
    assert task._air_time_s.flatten().tolist() == pytest.approx([0.02] * 16)


def test_a_step_without_reset_begins_on_the_tiles(make) -> None:
    task = make(*EXACT)
    *_, dones, _ = task.step(task.zero_actions())
    assert not dones.any()
    offset = task.simulation.root_states[:, :3] - task.curriculum.origins(_all(task))
    assert offset[:, :2].abs().max() < 0.6


def test_asking_for_resets_leaves_running_episodes_alone(make) -> None:
    task = make(*EXACT)
    task.reset()
    task.progress_buf[:2] = 998
    *_, dones, _ = task.step(task.zero_actions())
    assert dones.tolist() == [1, 1, 0, 0]
    before = task.simulation.root_states.clone()
    _, ids = task.reset_done()
    assert len(ids) == 0
    assert torch.equal(task.simulation.root_states, before)


def _lie_down(task) -> None:
    """Write robots on their bellies, a hair above the ground of their tiles."""
    pos = task.curriculum.origins(_all(task)) + torch.tensor([0.0, 0.0, 0.105])
    root = task.simulation.root_states.clone()
    root[:, :3], root[:, 3:7], root[:, 7:] = pos, torch.tensor([0.0, 0.0, 0.0, 1.0]), 0.0
    # Legs up in the air.
    joints = torch.tensor([0.0, 3.0, 0.0, 0.0, -3.0, 0.0] * 2).repeat(task.num_envs, 1)
    task.simulation.write_state(_all(task), root, joints, torch.zeros_like(joints))


def _step_until_done(task, actions: torch.Tensor):
    for _ in range(20):
        result = task.step(actions)
        if result[2].any():
            return result
    raise AssertionError("nothing ended")


def test_a_trunk_on_the_ground_ends_the_episode_and_is_no_time_out(make) -> None:
    task = make(*EXACT, "task.env.learn.terminalReward=-10", num_envs=1)
    task.reset()
    task.progress_buf[:] = 500
    _lie_down(task)
    hold = (task.simulation.dof_pos - task.default_dof_pos) / 0.5
    _, rewards, _, infos = _step_until_done(task, hold)
    assert not infos["time_outs"].any()
    assert task.reward_terms["terminal"].tolist() == pytest.approx([-0.2])
    others = sum(term for name, term in task.reward_terms.items() if name != "terminal")
    assert rewards.item() == pytest.approx(max(others.item(), 0.0) - 0.2, abs=1e-6)
    assert task.progress_buf.tolist() == [0]


@pytest.mark.parametrize("allowed", [True, False])
def test_knees_end_an_episode_only_if_they_must_not_touch(make, allowed: bool) -> None:
    task = make(*EXACT, f"task.env.learn.allowKneeContacts={allowed}", num_envs=1)
    task.reset()
    pos = task.curriculum.origins(_all(task)) + torch.tensor([0.0, 0.0, 0.36])
    root = task.simulation.root_states.clone()
    root[:, :3], root[:, 7:] = pos, 0.0
    joints = torch.tensor([[0.0, 0.6, -2.4, 0.0, -0.6, 2.4] * 2])
    task.simulation.write_state(_all(task), root, joints, torch.zeros_like(joints))
    hold = (joints - task.default_dof_pos) / 0.5
    collided = False
    for _ in range(20):
        *_, dones, _ = task.step(hold)
        collided |= bool(task.reward_terms["collision"].min() < 0.0)
        if dones.any() or collided:
            break
    assert collided
    assert dones.tolist() == [int(not allowed)]


@pytest.mark.parametrize(("published", "counted"), [(False, 0.02), (True, 0.005)])
def test_time_in_the_air(make, published: bool, counted: float) -> None:
    task = make(*EXACT, f"task.env.learn.airTimeAsPublished={published}")
    task.reset()
    for _ in range(3):
        task.step(task.zero_actions())
    assert task._air_time_s.flatten().tolist() == pytest.approx([3 * counted] * 16)
    task.commands[:, :2] = 1.0
    for _ in range(30):
        task.step(task.zero_actions())
        if task.reward_terms["air_time"].any():
            break
    assert task.reward_terms["air_time"].min() < -0.02 * 0.3


# --- pushes ---------------------------------------------------------------------------------


def test_pushes_replace_the_velocity_over_the_ground(make) -> None:
    def velocities(pushes: bool) -> list[torch.Tensor]:
        task = make(
            *SMALL[1:],
            "task.env.learn.addNoise=False",
            f"task.env.learn.pushRobots={pushes}",
            "task.env.learn.pushInterval_s=0.06",
            num_envs=64,
        )
        task.reset()
        noted = []
        for _ in range(3):
            task.step(task.zero_actions())
            noted.append(task.simulation.root_states[:, 7:].clone())
        assert torch.allclose(task.observe()[:, :3], 2.0 * task.base_motion().lin_vel.t())
        return noted

    pushed, free = velocities(True), velocities(False)
    assert torch.equal(pushed[0], free[0])
    assert torch.equal(pushed[1], free[1])
    over_ground = pushed[2][:, :2]
    assert -1.0 <= over_ground.min() < -0.9
    assert 0.9 < over_ground.max() <= 1.0
    # Replaced, not added: also the fall goes on, and so do the turns.
    assert torch.allclose(pushed[2][:, 2:], free[2][:, 2:], atol=1e-6)
    assert (pushed[2][:, :2] - free[2][:, :2]).abs().min(dim=1).values.median() > 0.05


def test_the_published_interval_is_750_steps(make) -> None:
    assert make()._push_interval == 750


def test_a_fall_is_noticed_in_a_step_with_a_push(make) -> None:
    task = make("task.env.learn.addNoise=False", "task.env.learn.pushInterval_s=0.02", num_envs=1)
    task.reset()
    _lie_down(task)
    hold = (task.simulation.dof_pos - task.default_dof_pos) / 0.5
    _step_until_done(task, hold)
    assert task.reward_terms["torques"].min() < 0.0


# --- levels ---------------------------------------------------------------------------------


def test_levels_follow_the_distance_walked(make) -> None:
    task = make(*EXACT)
    task.curriculum.levels[:] = 1
    task.reset()
    # 0.5 m/s for 20 s is 10 m: below 2.5 m a robot goes back.
    task.commands[:, 0], task.commands[:, 1] = 0.3, 0.4
    away = torch.tensor([[4.2, 0.0, 2.0], [0.0, 3.0, 2.0], [2.4, 0.0, 2.0], [4.2, 0.0, 2.0]])
    _put(task, pos=task.curriculum.origins(_all(task)) + away, vel=0.0)
    task.progress_buf[:] = torch.tensor([998, 998, 998, 500])
    *_, infos = task.step(task.zero_actions())
    assert task.curriculum.levels.tolist() == [2, 1, 0, 1]
    assert infos["episode"]["terrain_level"] == pytest.approx(1.0)
    offset = task.simulation.root_states[:3, :2] - task.curriculum.origins(_all(task))[:3, :2]
    assert offset.abs().max() <= 0.5


def test_levels_stay_where_an_episode_was_ended_from_outside(make) -> None:
    task = make(*EXACT)
    task.curriculum.levels[:] = 1
    task.reset()
    for _ in range(3):
        task.step(task.zero_actions())
    task.reset()
    assert task.curriculum.levels.tolist() == [1] * 4
    # Nor do they move again where one ended and the next has not made a step.
    task.commands[:, 0] = 1.0
    task.progress_buf[:2] = 998
    *_, dones, _ = task.step(task.zero_actions())
    assert dones.tolist() == [1, 1, 0, 0]
    assert task.curriculum.levels.tolist() == [0, 0, 1, 1]
    task.curriculum.levels[:] = 2
    task.reset()
    assert task.curriculum.levels.tolist() == [2] * 4


def test_a_diverged_robot_is_not_promoted(make) -> None:
    task = make(*EXACT)
    task.curriculum.levels[:] = 1
    task.reset()
    task.progress_buf[:] = 100
    vel = torch.zeros(4, 6)
    vel[2] = 1e6
    _put(task, vel=vel)
    *_, dones, infos = task.step(task.zero_actions())
    assert dones.tolist() == [0, 0, 1, 0]
    assert task.curriculum.levels.tolist() == [1] * 4
    assert "episode" not in infos
    assert task.simulation.root_states.isfinite().all()


def test_levels_come_back_from_a_checkpoint(make) -> None:
    task, other, more = make(), make(seed=1), make(num_envs=5)
    task.curriculum.levels[:] = torch.tensor([2, 0, 1, 2])
    for taker in (other, more):
        taker.set_env_state(task.get_env_state())
        taker.set_env_state(None)
    other.reset()
    assert other.curriculum.levels.tolist() == [2, 0, 1, 2]
    assert other.simulation.root_states[0, 0] > 16.0
    assert more.curriculum.levels.tolist() == [0] * 5


# --- what is told ---------------------------------------------------------------------------


def test_infos_tell_what_ended_episodes_were_paid(make) -> None:
    task = make(*EXACT)
    task.reset()
    paid = torch.zeros(len(TERM_NAMES), 4)
    for step in range(10):
        if step == 9:
            task.progress_buf[1:3] = 998
        *_, infos = task.step(0.3 * torch.randn(4, 12))
        paid += torch.stack([task.reward_terms[name] for name in TERM_NAMES])
        assert ("episode" in infos) == (step == 9)
    told = infos["episode"]
    assert set(told) == {f"rew_{name}" for name in TERM_NAMES} | {"terrain_level"}
    for name, row in zip(TERM_NAMES, paid, strict=True):
        assert told[f"rew_{name}"].item() == pytest.approx(row[1:3].mean().item() / 20.0, rel=1e-4)
    # Other steps tell nothing, and the next episode begins at zero.
    *_, infos = task.step(task.zero_actions())
    assert set(infos) == {"time_outs"}
    first = task.reward_terms["lin_vel_xy"][1].item()
    task.progress_buf[1] = 998
    *_, infos = task.step(task.zero_actions())
    both = first + task.reward_terms["lin_vel_xy"][1].item()
    assert infos["episode"]["rew_lin_vel_xy"].item() == pytest.approx(both / 20.0, rel=1e-4)


def test_noise_is_for_the_policy_and_not_for_the_critic(make) -> None:
    task = make("task.env.asymmetric_observations=True", num_envs=256)
    observations = task.reset()
    for _ in range(2):
        noise = observations["obs"] - observations["states"]
        half_widths = task._noise_widths
        assert (noise.abs() <= half_widths + 1e-5).all()
        assert (noise.abs().max(dim=0).values >= 0.9 * half_widths).all()
        assert noise.mean(dim=0).abs().max() < 0.1
        assert torch.equal(observations["states"], task.observe())
        observations, *_ = task.step(task.zero_actions())


def test_without_noise_the_observation_is_exact(make) -> None:
    task = make(*EXACT)
    assert torch.equal(task.reset()["obs"], task.observe())


def test_actions_and_observations_are_not_clamped(make) -> None:
    task = make(*EXACT)
    task.reset()
    observed, *_ = task.step(torch.full((4, 12), 9.0))
    assert (observed["obs"][:, 176:] == 9.0).all()


def test_published_names_of_files_stand_for_ours(make) -> None:
    task = make("task.env.urdfAsset.file=urdf/anymal_c/urdf/anymal_minimal.urdf")
    assert task.simulation.model.body("base").mass[0] == pytest.approx(27.8029)
