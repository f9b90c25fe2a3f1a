"""Humanoid: formulas by hand, its model against the tables, its ends and starts."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.paths import assets_dir
from isaacgymenvs_lite.tasks.base.locomotion import TorsoState, compute_torso_state
from isaacgymenvs_lite.tasks.base.vec_task import Done
from isaacgymenvs_lite.tasks.humanoid import (
    HumanoidConfig,
    compute_humanoid_observations,
    compute_humanoid_reward,
)

# damping (Nm s/rad), stiffness (Nm/rad), armature (kg m^2)
BASE, SMALL, BIG = (0.1, 5, 0.007), (1, 2, 0.006), (5, 10, 0.01)
BIGGER_STIFF, BIG_STIFF = (5, 20, 0.01), (5, 20, 0.02)
# joint, body, height of its anchor (m), axis, range (deg), class, torque of a full action (Nm)
JOINTS = [
    ("abdomen_z", "lower_waist", 0.065, (0, 0, 1), (-45, 45), BIG_STIFF, 67.5),
    ("abdomen_y", "lower_waist", 0.065, (0, 1, 0), (-75, 30), BIGGER_STIFF, 67.5),
    ("abdomen_x", "pelvis", 0.1, (1, 0, 0), (-35, 35), BIG, 67.5),
    ("right_hip_x", "right_thigh", 0, (1, 0, 0), (-45, 15), BIG, 45),
    ("right_hip_z", "right_thigh", 0, (0, 0, 1), (-60, 35), BIG, 45),
    ("right_hip_y", "right_thigh", 0, (0, 1, 0), (-120, 45), BIGGER_STIFF, 135),
    ("right_knee", "right_shin", 0.02, (0, -1, 0), (-160, 2), BASE, 90),
    ("right_ankle_y", "right_foot", 0.08, (0, 1, 0), (-50, 50), SMALL, 22.5),
    ("right_ankle_x", "right_foot", 0.08, (1, 0, 0.5), (-50, 50), SMALL, 22.5),
    ("left_hip_x", "left_thigh", 0, (-1, 0, 0), (-45, 15), BIG, 45),
    ("left_hip_z", "left_thigh", 0, (0, 0, -1), (-60, 35), BIG, 45),
    ("left_hip_y", "left_thigh", 0, (0, 1, 0), (-120, 45), BIGGER_STIFF, 135),
    ("left_knee", "left_shin", 0.02, (0, -1, 0), (-160, 2), BASE, 90),
    ("left_ankle_y", "left_foot", 0.08, (0, 1, 0), (-50, 50), SMALL, 22.5),
    ("left_ankle_x", "left_foot", 0.08, (1, 0, 0.5), (-50, 50), SMALL, 22.5),
    ("right_shoulder1", "right_upper_arm", 0, (2, 1, 1), (-90, 70), BIG, 67.5),
    ("right_shoulder2", "right_upper_arm", 0, (0, -1, 1), (-90, 70), BIG, 67.5),
    ("right_elbow", "right_lower_arm", 0, (0, -1, 1), (-90, 50), SMALL, 45),
    ("left_shoulder1", "left_upper_arm", 0, (-2, 1, -1), (-90, 70), BIG, 67.5),
    ("left_shoulder2", "left_upper_arm", 0, (0, -1, -1), (-90, 70), BIG, 67.5),
    ("left_elbow", "left_lower_arm", 0, (0, -1, -1), (-90, 50), SMALL, 45),
]
# body, where its origin is in the standing body (m), mass (kg)
BODIES = [
    ("torso", (0, 0, 1.34), 5.854),
    ("head", (0, 0, 1.53), 3.054),
    ("lower_waist", (-0.01, 0, 1.08), 2.262),
    ("pelvis", (-0.01, 0, 0.915), 6.616),
    ("right_thigh", (-0.01, -0.1, 0.875), 4.752),
    ("right_shin", (-0.01, -0.09, 0.472), 2.756),
    ("right_foot", (-0.01, -0.09, 0.082), 1.131),
    ("left_thigh", (-0.01, 0.1, 0.875), 4.752),
    ("left_shin", (-0.01, 0.09, 0.472), 2.756),
    ("left_foot", (-0.01, 0.09, 0.082), 1.131),
    ("right_upper_arm", (0, -0.17, 1.4), 1.661),
    ("right_lower_arm", (0.18, -0.35, 1.22), 0.962),
    ("right_hand", (0.36, -0.17, 1.4), 0.268),
    ("left_upper_arm", (0, 0.17, 1.4), 1.661),
    ("left_lower_arm", (0.18, 0.35, 1.22), 0.962),
    ("left_hand", (0.36, 0.17, 1.4), 0.268),
]
TORQUES_NM = torch.tensor([joint[-1] for joint in JOINTS])
LIMITS_RAD = torch.deg2rad(torch.tensor([joint[4] for joint in JOINTS], dtype=torch.float32))
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
# On the back: nothing touches the floor although the torso is low.
LYING = (0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5))


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(assets_dir() / "mjcf" / "humanoid.xml"))


def _put(task, height: float, rotation=UPRIGHT, vel=(0.0, 0.0, 0.0), dof_pos=None) -> None:
    """Put all humanoids into one state."""
    n = task.num_envs
    root = torch.zeros(n, 13)
    root[:, 2] = height
    root[:, 3:7] = torch.tensor(rotation)
    root[:, 7:10] = torch.tensor(vel)
    joints = torch.zeros(n, 21)
    task.simulation.write_state(
        torch.arange(n), root, joints if dof_pos is None else dof_pos, joints
    )


# --- model ----------------------------------------------------------------------------------


def test_bodies_of_the_table(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert [model.body(i).name for i in range(1, model.nbody)] == [name for name, *_ in BODIES]
    for name, place, mass in BODIES:
        # The table rounds to the gram.
        assert model.body(name).mass[0] == pytest.approx(mass, abs=1e-3), name
        # Two tilts by 0.004 rad, of at most 1 m, that the table's sums leave out.
        np.testing.assert_allclose(data.body(name).xpos, place, atol=0.009, err_msg=name)
    tilts = model.body_quat[np.abs(model.body_quat[:, 2]) > 0]
    np.testing.assert_allclose(tilts, [[1, 0, -0.002, 0]] * 2, atol=3e-6)


def test_joints_of_the_table(model: mujoco.MjModel) -> None:
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    assert [model.joint(i).name for i in range(1, model.njnt)] == [row[0] for row in JOINTS]
    for name, body, anchor, axis, limits, (damping, stiffness, armature), _ in JOINTS:
        joint = model.joint(name)
        assert model.body(int(joint.bodyid[0])).name == body
        np.testing.assert_allclose(joint.pos, [0, 0, anchor])
        np.testing.assert_allclose(joint.axis, np.array(axis) / np.linalg.norm(axis))
        np.testing.assert_allclose(np.rad2deg(joint.range), limits)
        assert (joint.limited[0], joint.qpos_spring[0]) == (1, 0.0)
        found = (joint.damping[0], joint.stiffness[0], joint.armature[0])
        assert found == pytest.approx((damping, stiffness, armature)), name


def test_legs_collide_without_friction_and_joined_parts_do_not(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    # Joined parts overlap all over the standing body.
    assert data.ncon == 0
    for name in ("right_hip_x", "left_hip_x"):
        data.joint(name).qpos[0] = math.radians(15)
    mujoco.mj_forward(model, data)
    bodies = {frozenset(model.geom_bodyid[c.geom].tolist()) for c in data.contact[: data.ncon]}
    shins = frozenset(int(model.body(f"{side}_shin").id) for side in ("right", "left"))
    assert shins in bodies
    assert {c.dim for c in data.contact[: data.ncon]} == {1}


# --- actions --------------------------------------------------------------------------------


def test_full_actions_turn_the_joints_with_the_tables_torques(make_task) -> None:
    for scale in (1.0, 0.5):
        # One physics step from rest at zero: no spring or damper acts.
        task = make_task(
            "task=Humanoid", "task.sim.substeps=1", f"task.env.powerScale={scale}", num_envs=42
        )
        task.reset()
        _put(task, 3.0)
        one_joint = torch.cat((torch.eye(21), -3.0 * torch.eye(21)))
        observed = task.step(one_joint)[0]["obs"]
        torques = torch.diag(TORQUES_NM) * scale
        torch.testing.assert_close(task.simulation.dof_forces, torch.cat((torques, -torques)))
        torch.testing.assert_close(observed[:, 54:75], torch.cat((torques, -torques)) * 0.01)
        # Torques turn joints their way.
        moved = task.simulation.dof_vel[:21].diagonal(), task.simulation.dof_vel[21:].diagonal()
        assert (moved[0] > 0).all()
        assert (moved[1] < 0).all()


def test_springs_pull_joints_to_zero_from_the_first_step_on(make_task) -> None:
    task = make_task("task=Humanoid", "task.sim.substeps=1", num_envs=1)
    task.reset_buf[:] = 0  # instead of a reset, which would read the torques once before the step
    pos = torch.linspace(-0.5, -0.1, 21)[None]
    _put(task, 3.0, dof_pos=pos)
    observed = task.step(task.zero_actions())[0]["obs"]
    stiffness = torch.tensor([joint[5][1] for joint in JOINTS])
    torch.testing.assert_close(observed[:, 54:75], -stiffness * pos * 0.01)


# --- observation ----------------------------------------------------------------------------


def test_order_and_scales_of_the_observation() -> None:
    cfg = HumanoidConfig(angular_velocity_scale=0.25)
    roll, yaw = -0.3, -2.0
    torso_to_world = _about_z(yaw) @ _about_x(roll)
    half = 0.5 * np.array([roll, yaw])
    (sr, sy), (cr, cy) = np.sin(half), np.cos(half)
    root = np.concatenate(
        (
            [10.0, -5.0, 1.2],
            [sr * cy, sr * sy, cr * sy, cr * cy],  # about the torso's x axis, then about z
            torso_to_world @ [1.0, 2.0, 3.0],
            torso_to_world @ [4.0, -8.0, 12.0],
        )
    )
    lower, upper = LIMITS_RAD.unbind(-1)
    dofs = torch.arange(21.0)[None]
    rows = compute_humanoid_observations(
        compute_torso_state(torch.tensor(root, dtype=torch.float32)[None]),
        lower + 0.75 * (upper - lower)[None],
        dofs,
        100.0 + dofs,
        lower,
        upper,
        200.0 + torch.arange(12.0)[:, None],
        300.0 + dofs,
        cfg,
    )
    to_target = np.array([990.0, 5.0]) / math.hypot(990.0, 5.0)
    expected = [
        *(1.2, 1.0, 2.0, 3.0, 1.0, -2.0, 3.0),
        *(yaw, roll, math.atan2(-1.2, 990.0) - yaw),
        math.cos(roll),
        math.cos(yaw) * to_target[0] + math.sin(yaw) * to_target[1],
        *[0.5] * 21,
        *[0.1 * i for i in range(21)],
        *[0.01 * (100 + i) for i in range(21)],
        *[0.01 * (200 + i) for i in range(12)],
        *[300.0 + i for i in range(21)],
    ]
    # float32 quantities, products of three factors.
    np.testing.assert_allclose(rows.numpy(), [expected], rtol=1e-5, atol=1e-5)


def _about_z(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _about_x(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def test_the_right_foots_sensor_comes_first(make_task) -> None:
    task = make_task("task=Humanoid", "task.sim.substeps=1", num_envs=2)
    task.reset()
    height = 1.34 - 0.055 - 0.005  # feet 5 mm in the floor
    pos = torch.zeros(2, 21)
    pos[0, 12] = pos[1, 6] = -1.5  # the other leg's knee is bent
    _put(task, height, dof_pos=pos)
    observed = task.step(task.zero_actions())[0]["obs"]

    model = task.simulation.model
    data = mujoco.MjData(model)
    data.qpos[2], data.joint("left_knee").qpos[0] = height, -1.5
    mujoco.mj_forward(model, data)
    normal = 0.0
    for contact in range(data.ncon):
        force = np.zeros(6)
        mujoco.mj_contactForce(model, data, contact, force)
        normal += force[0]
    assert normal > 100.0
    standing, lifted = observed[[0, 1], 75:87].reshape(2, 2, 6).unbind(1)
    # The foot is tilted by 0.008 rad, and the sensor read in the frame of one step later.
    assert standing[0, 2].item() == pytest.approx(0.01 * normal, rel=2e-3)
    assert standing[1].abs().max() == 0.0
    assert lifted[0].abs().max() == 0.0
    assert lifted[1, 2].item() == pytest.approx(0.01 * normal, rel=2e-3)
    # Mirrored stances: what pushes forward does alike, what pushes sideways does not.
    mirror = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    torch.testing.assert_close(lifted[1], standing[0] * mirror, rtol=1e-4, atol=1e-4)


# --- reward ---------------------------------------------------------------------------------


def _torso(height: float = 1.2, up_proj: float = 0.94, heading_proj: float = 0.4) -> TorsoState:
    one, nothing = torch.ones(1), torch.zeros(1)
    return TorsoState(
        height * one, torch.zeros(3, 1), torch.zeros(3, 1), nothing, nothing, nothing,
        up_proj * one, heading_proj * one,
    )  # fmt: skip


def _terms(torso: TorsoState) -> dict[str, float]:
    terms = compute_humanoid_reward(
        torso,
        torch.tensor([1.5]),
        actions=torch.tensor([[1.0, -0.5, 0.0]]),
        dof_pos_share=torch.tensor([[0.99, -1.01, 0.97]]),
        dof_vel_scaled=torch.tensor([[0.2, 0.4, 9.0]]),
        motor_effort_ratio=torch.tensor([0.5, 1.0, 0.25]),
        cfg=HumanoidConfig(),
    )
    return {name: value.item() for name, value in terms.items()}


def test_reward_of_the_specification() -> None:
    assert _terms(_torso()) == pytest.approx(
        {
            "progress": 1.5,
            "alive": 2.0,
            "heading": 0.5 * 0.4 / 0.8,
            "up": 0.1,
            "actions": -0.01 * (1.0 + 0.25),
            "energy": -0.05 * (0.2 * 0.5 + 0.2 * 1.0),
            "joints_at_limit": -0.25 * (0.5 * 0.5 + 1.5 * 1.0),
            "fall": 0.0,
        },
        abs=5e-6,  # 0.99 - 0.98 in float32, divided by 0.02
    )


def test_thresholds_of_heading_and_uprightness() -> None:
    terms = _terms(_torso(up_proj=0.92, heading_proj=0.81))
    assert (terms["heading"], terms["up"]) == (0.5, 0.0)


def test_a_fall_costs_one_whatever_else_is() -> None:
    fallen, low = _terms(_torso(height=0.79)), _terms(_torso(height=0.81))
    assert sum(fallen.values()) == fallen["fall"] == -1.0
    assert low["fall"] == 0.0
    assert sum(low.values()) == pytest.approx(3.385, abs=1e-5)


def test_the_task_pays_for_its_own_joints(make_task) -> None:
    """The reward's terms from the simulation's tensors instead of slices of the observation."""
    task = make_task("task=Humanoid", num_envs=16)
    task.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(10):
        actions = 2.0 * torch.rand(16, 21, generator=generator) - 1.0
        task.step(actions)
    assert not (task.done_buf == Done.FAILED).any()
    shares = TORQUES_NM / 135.0
    lower, upper = LIMITS_RAD.unbind(-1)
    share = (task.simulation.dof_pos - lower) / (upper - lower) * 2.0 - 1.0
    over = ((share.abs() - 0.98) / 0.02).clamp(min=0.0)
    power = (actions * 0.1 * task.simulation.dof_vel).abs()
    terms = task.reward_terms
    # The limit's cost magnifies what rounding makes of `share` 50 times.
    torch.testing.assert_close(
        terms["joints_at_limit"], -0.25 * (over * shares).sum(-1), rtol=1e-4, atol=1e-4
    )
    torch.testing.assert_close(terms["energy"], -0.05 * (power * shares).sum(-1))
    torch.testing.assert_close(terms["actions"], -0.01 * actions.square().sum(-1))
    assert terms["joints_at_limit"].min() < -0.1
    assert terms["alive"].tolist() == [2.0] * 16


def test_progress_is_the_speed_along_x(make_task) -> None:
    for vel, expected in [((2.0, 0.0, 0.0), 2.0), ((0.0, 2.0, 0.0), 0.0)]:
        task = make_task("task=Humanoid", num_envs=1)
        task.reset()
        _put(task, 3.0, vel=vel)
        for _ in range(3):
            _, _, _, infos = task.step(task.zero_actions())
            # Distances of 1000 m over 0.0166 s are known to 0.004 m/s in float32.
            assert task.reward_terms["progress"].item() == pytest.approx(expected, abs=0.008)
            assert infos["true_objective"].item() == pytest.approx(expected, abs=1e-3)


def test_a_reset_is_no_progress(make_task) -> None:
    task = make_task("task=Humanoid")
    task.reset()
    _put(task, 3.0, vel=(5.0, 0.0, 0.0))
    for _ in range(5):
        task.step(task.zero_actions())
    assert (task.simulation.root_states[:, 0] > 0.3).all()
    task.reset_buf[1] = 1
    task.step(task.zero_actions())
    progress = task.reward_terms["progress"]
    assert progress[1] == 0.0
    assert progress[[0, 2, 3]].tolist() == pytest.approx([5.0] * 3, abs=0.02)
    assert (task.simulation.root_states[1, :2] == 0.0).all()


# --- ends and starts ------------------------------------------------------------------------


def test_a_torso_below_80_cm_ends_the_episode(make_task) -> None:
    task = make_task("task=Humanoid")
    task.reset()
    task.progress_buf[:] = 500
    _put(task, 0.81, LYING)
    _, rewards, dones, _ = task.step(task.zero_actions())
    assert not dones.any()
    assert (rewards > 0.0).all()
    _put(task, 0.79, LYING)
    _, rewards, dones, infos = task.step(task.zero_actions())
    assert dones.all()
    assert not infos["time_outs"].any()
    assert rewards.tolist() == [-1.0] * 4


def test_starts_are_upright_at_rest_with_the_joints_near_zero(make_task) -> None:
    task = make_task("task=Humanoid", num_envs=256)
    torch.manual_seed(0)
    task.reset()
    sim = task.simulation
    expected = torch.zeros(256, 13)
    expected[:, 2], expected[:, 6] = 1.34, 1.0
    torch.testing.assert_close(sim.root_states, expected)
    knees = [6, 12]
    others = [i for i in range(21) if i not in knees]
    # Of 4864 draws: sigma of the deviation is 0.5% of it; 3% is far outside chance.
    for values, bound in ((sim.dof_pos[:, others], 0.2), (sim.dof_vel, 0.1)):
        assert 0.99 * bound < values.abs().max() <= bound + 1e-6
        assert values.std().item() == pytest.approx(bound / math.sqrt(3.0), rel=0.03)
        assert values.mean(0).abs().max() < 0.25 * bound
    knee_pos = sim.dof_pos[:, knees]
    assert -0.2 <= knee_pos.min() < -0.19
    assert knee_pos.max().item() == pytest.approx(math.radians(2.0), abs=1e-6)


# --- files ----------------------------------------------------------------------------------
