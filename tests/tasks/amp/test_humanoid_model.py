"""The MJCF against the published body, joint and motor tables; what the task's keys change."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import HumanoidAMPBase

# name, parent, offset in the parent (m), mass (kg)
BODIES = [
    ("pelvis", "world", (0.0, 0.0, 1.0), 9.9956),
    ("torso", "pelvis", (0.0, 0.0, 0.236151), 12.0115),
    ("head", "torso", (0.0, 0.0, 0.223894), 3.8823),
    ("right_upper_arm", "torso", (-0.02405, -0.18311, 0.24350), 1.4993),
    ("right_lower_arm", "right_upper_arm", (0.0, 0.0, -0.274788), 0.9997),
    ("right_hand", "right_lower_arm", (0.0, 0.0, -0.258947), 0.5000),
    ("left_upper_arm", "torso", (-0.02405, 0.18311, 0.24350), 1.4993),
    ("left_lower_arm", "left_upper_arm", (0.0, 0.0, -0.274788), 0.9997),
    ("left_hand", "left_lower_arm", (0.0, 0.0, -0.258947), 0.5000),
    ("right_thigh", "pelvis", (0.0, -0.084887, 0.0), 4.5023),
    ("right_shin", "right_thigh", (0.0, 0.0, -0.421546), 2.9997),
    ("right_foot", "right_shin", (0.0, 0.0, -0.409870), 0.9997),
    ("left_thigh", "pelvis", (0.0, 0.084887, 0.0), 4.5023),
    ("left_shin", "left_thigh", (0.0, 0.0, -0.421546), 2.9997),
    ("left_foot", "left_shin", (0.0, 0.0, -0.409870), 0.9997),
]
# joint, degrees of freedom, kp, kd, armature, effort (Nm)
DRIVES = [
    ("abdomen", 3, 600, 60, 0.025, 125),
    ("neck", 3, 50, 5, 0.017, 20),
    ("right_shoulder", 3, 200, 20, 0.02, 70),
    ("right_elbow", 1, 150, 15, 0.015, 60),
    ("left_shoulder", 3, 200, 20, 0.02, 70),
    ("left_elbow", 1, 150, 15, 0.015, 60),
    ("right_hip", 3, 300, 30, 0.02, 125),
    ("right_knee", 1, 300, 30, 0.02, 100),
    ("right_ankle", 3, 200, 20, 0.01, 50),
    ("left_hip", 3, 300, 30, 0.02, 125),
    ("left_knee", 1, 300, 30, 0.02, 100),
    ("left_ankle", 3, 200, 20, 0.01, 50),
]
# The tables have four decimals.
FOUR_DECIMALS = 5.1e-5
FIVE_DECIMALS = 5.1e-6


def _build(env: dict[str, Any] | None = None) -> mujoco.MjModel:
    cfg = {"env": {"numEnvs": 1, **(env or {})}, "sim": {"dt": 0.0166}}
    task = HumanoidAMPBase(cfg, "cpu", "cpu", -1, True)
    task.close()
    return task.simulation.model


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return _build()


# --- bodies -----------------------------------------------------------------------------------


def test_tree_offsets_and_masses(model: mujoco.MjModel) -> None:
    assert model.nbody == 1 + len(BODIES)
    for index, (name, parent, offset, mass) in enumerate(BODIES, start=1):
        body = model.body(index)
        assert body.name == name
        assert model.body(int(body.parentid[0])).name == parent
        np.testing.assert_allclose(body.pos, offset, atol=1e-9, err_msg=name)
        assert float(body.mass[0]) == pytest.approx(mass, abs=FOUR_DECIMALS), name
    assert float(model.body_mass.sum()) == pytest.approx(48.8908, abs=FOUR_DECIMALS)


def test_centres_of_mass_and_inertias(model: mujoco.MjModel) -> None:
    for name, centre_m, inertia in [
        ("pelvis", (0.0, 0.0, 0.1132), (0.06793, 0.06793, 0.02829)),
        ("torso", (-0.0019, 0.0, 0.1389), (0.08984, 0.07201, 0.06818)),
        ("right_foot", (0.045, 0.0, -0.0225), (0.00093, 0.00286, 0.00328)),
        ("left_foot", (0.045, 0.0, -0.0225), (0.00093, 0.00286, 0.00328)),
    ]:
        body = model.body(name)
        np.testing.assert_allclose(body.ipos, centre_m, atol=FOUR_DECIMALS)
        # Principal moments; MuJoCo sorts them or not as it likes.
        np.testing.assert_allclose(sorted(body.inertia), sorted(inertia), atol=FIVE_DECIMALS)


# --- joints and drives ------------------------------------------------------------------------


def test_gains_efforts_and_armature(model: mujoco.MjModel) -> None:
    first = 0
    for joint, size, kp, kd, armature, effort in DRIVES:
        dofs = slice(first, first + size)
        message = f"{joint}, actuators {dofs}"
        np.testing.assert_allclose(model.actuator_gainprm[dofs, 0], kp, err_msg=message)
        np.testing.assert_allclose(
            model.actuator_biasprm[dofs, :3], [[0.0, -kp, -kd]] * size, err_msg=message
        )
        efforts = [[-effort, effort]] * size
        np.testing.assert_allclose(model.actuator_forcerange[dofs], efforts, err_msg=message)
        in_qvel = slice(6 + first, 6 + first + size)
        np.testing.assert_allclose(model.dof_armature[in_qvel], armature, err_msg=message)
        first += size
    assert first == model.nu == model.nv - 6 == 28


def test_joint_kinds_axes_and_ranges(model: mujoco.MjModel) -> None:
    hinges = {"right_elbow": (-160, 0), "left_elbow": (-160, 0)}
    hinges |= {"right_knee": (0, 160), "left_knee": (0, 160)}
    # MuJoCo limits the angle of a ball joint: the corner of the published box of limits (deg).
    corners = {
        "abdomen": math.hypot(60.0, 90.0, 50.0),
        "neck": math.hypot(50.0, 60.0, 45.0),
        "hip": math.hypot(60.0, 140.0, 60.0),
        "ankle": math.hypot(30.0, 55.0, 40.0),
    }
    assert model.joint(0).type[0] == mujoco.mjtJoint.mjJNT_FREE
    for joint, size, *_ in DRIVES:
        found = model.joint(joint)
        low, high = np.rad2deg(found.range)
        if size == 1:
            assert found.type[0] == mujoco.mjtJoint.mjJNT_HINGE
            np.testing.assert_allclose(found.axis, [0.0, 1.0, 0.0])
            np.testing.assert_allclose((low, high), hinges[joint], err_msg=joint)
            assert model.jnt_limited[found.id] == 1
        else:
            assert found.type[0] == mujoco.mjtJoint.mjJNT_BALL
            name = joint.removeprefix("right_").removeprefix("left_")
            if name == "shoulder":  # 180 deg and more: no limit
                assert model.jnt_limited[found.id] == 0
            else:
                assert float(high) == pytest.approx(corners[name], abs=0.05), joint
                assert model.jnt_limited[found.id] == 1


def test_actuator_lengths_are_the_rotation_vectors(model: mujoco.MjModel) -> None:
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    data.qpos[2] = 5.0
    expected: list[float] = []
    for joint, size, *_ in DRIVES:
        address = int(model.joint(joint).qposadr[0])
        if size == 3:
            vector = rng.uniform(-1.8, 1.8, 3)  # at most 3.12 rad long
            data.qpos[address : address + 4] = Rotation.from_rotvec(vector).as_quat(
                scalar_first=True
            )
            expected += vector.tolist()
        else:
            data.qpos[address] = rng.uniform(-1.0, 1.0)
            expected.append(float(data.qpos[address]))
    data.qvel[6:] = rng.normal(size=28)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.actuator_length, expected, atol=1e-12)
    # Rotation vector and angular velocity are in the child's frame.
    arm, torso = data.body("right_upper_arm").xquat, data.body("torso").xquat
    relative = Rotation.from_quat(torso, scalar_first=True).inv() * Rotation.from_quat(
        arm, scalar_first=True
    )
    np.testing.assert_allclose(relative.as_rotvec(), expected[6:9], atol=1e-12)
    # The damping of the drive acts on these velocities.
    np.testing.assert_allclose(data.actuator_velocity, data.qvel[6:], atol=1e-12)


# --- collisions -------------------------------------------------------------------------------


def _touching_pairs(model: mujoco.MjModel) -> set[frozenset[str]]:
    """Pairs of bodies that touch in some of 150 random poses far above the floor."""
    rng = np.random.default_rng(1)
    data = mujoco.MjData(model)
    pairs = set()
    for _ in range(150):
        data.qpos[2] = 5.0
        data.qpos[7:] = rng.normal(size=model.nq - 7)
        mujoco.mj_forward(model, data)
        for contact in data.contact:
            bodies = model.geom_bodyid[contact.geom]
            pairs.add(frozenset(model.body(body).name for body in bodies))
    return pairs


def test_adjacent_bodies_never_collide_and_others_do(model: mujoco.MjModel) -> None:
    pairs = _touching_pairs(model)
    adjacent = {frozenset((name, parent)) for name, parent, *_ in BODIES}
    assert not pairs & adjacent
    for pair in (
        ("right_thigh", "left_thigh"),
        ("torso", "right_lower_arm"),
        ("head", "left_upper_arm"),
        ("pelvis", "left_hand"),
    ):
        assert frozenset(pair) in pairs, pair


def test_plane_friction_goes_into_floor_contacts_only() -> None:
    model = _build({"plane": {"dynamicFriction": 0.3}})
    data = mujoco.MjData(model)
    data.qpos[2] = 0.88
    mujoco.mj_forward(model, data)
    assert data.ncon == 8  # four corners of each sole
    for contact in data.contact:
        assert contact.dim == 3
        np.testing.assert_allclose(contact.friction[:2], 0.3)
    # Bodies touch each other without friction: turn the thighs into one another.
    for side, sign in (("right", 1.0), ("left", -1.0)):
        address = int(model.joint(f"{side}_hip").qposadr[0])
        turned = Rotation.from_rotvec([sign * 0.5, 0.0, 0.0]).as_quat(scalar_first=True)
        data.qpos[address : address + 4] = turned
    data.qpos[2] = 5.0
    mujoco.mj_forward(model, data)
    assert data.ncon > 0
    assert all(contact.dim == 1 for contact in data.contact)


# --- keys of the task -------------------------------------------------------------------------


def _force(model: mujoco.MjModel, control: float) -> np.ndarray:
    """Force of all actuators (28,) in the zero pose at rest under one control."""
    data = mujoco.MjData(model)
    data.ctrl[:] = control
    mujoco.mj_forward(model, data)
    return data.actuator_force


KP = np.array([row[2] for row in DRIVES for _ in range(row[1])])
EFFORT = np.array([row[5] for row in DRIVES for _ in range(row[1])])


def test_the_force_of_a_drive_does_not_turn_round_at_half_a_turn() -> None:
    # MuJoCo 4 wraps the error of a position servo on a ball joint (kp == -biasprm[1]) into
    # [-pi, pi]. A target of the action 1 is pi in float32, 9e-8 more than pi: there the torque
    # would turn round, where the drive of the originals is kp (target - q).
    model, pi32 = _build(), float(np.float32(math.pi))
    for target in (pi32 - 1e-6, pi32, 4.0):
        np.testing.assert_allclose(_force(model, target), target * KP, rtol=1e-6)


def test_drives_end_at_their_efforts_if_asked_to() -> None:
    limited = _build({"enforceEffortLimits": True})
    np.testing.assert_allclose(_force(limited, 2.5), EFFORT)
    np.testing.assert_allclose(_force(limited, -2.5), -EFFORT)
    np.testing.assert_allclose(_force(limited, 0.1), 0.1 * KP)
    for unlimited in (_build(), _build({"enforceEffortLimits": False})):
        np.testing.assert_allclose(_force(unlimited, 2.5), 2.5 * KP)


def test_a_missing_asset_lists_what_is_shipped(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no file .*nothing\.xml; shipped: .*amp_humanoid\.xml"):
        _build({"asset": {"assetFileName": "nothing.xml", "assetRoot": str(tmp_path)}})


def test_a_broken_asset_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "broken.xml").write_text("<mujoco>\n<worldbody>\n<body></mujoco>")
    with pytest.raises(ConfigError, match=r"broken\.xml is not valid XML") as error:
        _build({"asset": {"assetFileName": "broken.xml", "assetRoot": str(tmp_path)}})
    assert "\n" not in str(error.value)


def test_a_strangers_model_is_read_as_a_robot(tmp_path: Path) -> None:
    for rest, reason in [
        ('<extension><plugin plugin="a"/></extension>', "plugins are not loaded"),
        ('<asset><mesh file="/etc/passwd"/></asset>', "mesh '/etc/passwd'"),
    ]:
        body = '<body><freejoint/><geom size="1"/></body>'
        text = f"<mujoco><worldbody>{body}</worldbody>{rest}</mujoco>"
        (tmp_path / "theirs.xml").write_text(text, encoding="utf-8")
        with pytest.raises(ConfigError, match=reason) as error:
            _build({"asset": {"assetFileName": "theirs.xml", "assetRoot": str(tmp_path)}})
        assert "\n" not in str(error.value)
