"""Both humanoids: the limits of each axis; of the sword and shield variant, what ASE publishes."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.paths import assets_dir
from isaacgymenvs_lite.simulation.model_layout import ModelLayout

PLAIN = "amp_humanoid.xml"
SWORD_SHIELD = "amp_humanoid_sword_shield.xml"
# The published range of every degree of freedom, in degrees.
LIMITS_DEG = {
    "abdomen_x": (-60, 60),
    "abdomen_y": (-60, 90),
    "abdomen_z": (-50, 50),
    "neck_x": (-50, 50),
    "neck_y": (-40, 60),
    "neck_z": (-45, 45),
    "right_shoulder_x": (-180, 45),
    "right_shoulder_y": (-180, 60),
    "right_shoulder_z": (-90, 90),
    "right_elbow": (-160, 0),
    "right_hand_x": (-90, 90),
    "right_hand_y": (-90, 90),
    "right_hand_z": (-90, 90),
    "left_shoulder_x": (-45, 180),
    "left_shoulder_y": (-180, 60),
    "left_shoulder_z": (-90, 90),
    "left_elbow": (-160, 0),
    "right_hip_x": (-60, 15),
    "right_hip_y": (-140, 60),
    "right_hip_z": (-60, 35),
    "right_knee": (0, 160),
    "right_ankle_x": (-30, 30),
    "right_ankle_y": (-55, 55),
    "right_ankle_z": (-40, 40),
    "left_hip_x": (-15, 60),
    "left_hip_y": (-140, 60),
    "left_hip_z": (-35, 60),
    "left_knee": (0, 160),
    "left_ankle_x": (-30, 30),
    "left_ankle_y": (-55, 55),
    "left_ankle_z": (-40, 40),
}
# joint, degrees of freedom, kp, kd, armature, effort (Nm): ASE's columns
ASE_DRIVES = [
    ("abdomen", 3, 1000, 100, 0.02, 200),
    ("neck", 3, 100, 10, 0.01, 50),
    ("right_shoulder", 3, 400, 40, 0.02, 100),
    ("right_elbow", 1, 300, 30, 0.01, 70),
    ("right_hand", 3, 100, 10, 0.01, 50),
    ("left_shoulder", 3, 400, 40, 0.02, 100),
    ("left_elbow", 1, 300, 30, 0.01, 70),
    ("right_hip", 3, 500, 50, 0.02, 200),
    ("right_knee", 1, 500, 50, 0.02, 150),
    ("right_ankle", 3, 400, 40, 0.01, 90),
    ("left_hip", 3, 500, 50, 0.02, 200),
    ("left_knee", 1, 500, 50, 0.02, 150),
    ("left_ankle", 3, 400, 40, 0.01, 90),
]


def _compile(file: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(assets_dir() / "mjcf" / file))


@pytest.fixture(scope="module")
def plain() -> mujoco.MjModel:
    return _compile(PLAIN)


@pytest.fixture(scope="module")
def armed() -> mujoco.MjModel:
    return _compile(SWORD_SHIELD)


# --- limits -----------------------------------------------------------------------------------


def test_every_axis_has_its_published_limits() -> None:
    for file, num_dofs in [(PLAIN, 28), (SWORD_SHIELD, 31)]:
        model = _compile(file)
        dof_names = ModelLayout.from_model(model).dof_names
        assert len(dof_names) == model.nu == num_dofs
        for index, name in enumerate(dof_names):
            assert model.actuator(index).name == name
            joint = int(model.actuator_trnid[index, 0])
            is_ball = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL
            limits = model.actuator_lengthrange[index] if is_ball else model.jnt_range[joint]
            np.testing.assert_allclose(
                np.rad2deg(limits), LIMITS_DEG[name], atol=1e-9, err_msg=name
            )


def test_a_ball_joint_ends_at_the_corner_of_the_box_of_its_limits() -> None:
    for file in [PLAIN, SWORD_SHIELD]:
        model = _compile(file)
        for joint in range(1, model.njnt):
            if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_BALL:
                continue
            name = model.joint(joint).name
            largest = [max(map(abs, LIMITS_DEG[f"{name}_{axis}"])) for axis in "xyz"]
            corner = math.hypot(*largest)
            assert model.jnt_limited[joint] == (corner < 180.0), name
            if corner < 180.0:
                assert np.rad2deg(model.jnt_range[joint]) == pytest.approx([0.0, corner], abs=0.05)


# --- the sword and shield variant -------------------------------------------------------------


def test_the_bodies_and_their_parents(armed: mujoco.MjModel) -> None:
    # Each body and its parent, in order.
    tree = """
        pelvis world, torso pelvis, head torso,
        right_upper_arm torso, right_lower_arm right_upper_arm, right_hand right_lower_arm,
        sword right_hand, left_upper_arm torso, left_lower_arm left_upper_arm,
        shield left_lower_arm, left_hand left_lower_arm,
        right_thigh pelvis, right_shin right_thigh, right_foot right_shin,
        left_thigh pelvis, left_shin left_thigh, left_foot left_shin
    """
    expected = [tuple(pair.split()) for pair in tree.split(",")]
    bodies = [armed.body(i) for i in range(1, armed.nbody)]
    found = [(body.name, armed.body(int(body.parentid[0])).name) for body in bodies]
    assert found == expected
    sensors = [armed.sensor(i).name for i in range(armed.nsensor)]
    assert sensors == [f"contact_{name}" for name, _ in expected]
    assert armed.body_mass.sum() == pytest.approx(51.7125, abs=5e-5)


def test_the_sword(armed: mujoco.MjModel) -> None:
    sword, hilt, blade = armed.body("sword"), armed.geom("hilt"), armed.geom("blade")
    np.testing.assert_allclose(sword.pos, [0.74, 0.0, 0.0])
    assert sword.mass[0] == pytest.approx(0.7012, abs=5e-5)
    assert (sword.jntnum[0], hilt.bodyid[0], blade.bodyid[0]) == (0, sword.id, sword.id)
    # From 0.13 m behind the hand to 0.10 m in front of it; the blade ends at the body's origin.
    np.testing.assert_allclose(hilt.pos, [-0.755, 0.0, 0.0])
    np.testing.assert_allclose(hilt.size[:2], [0.023, 0.115])
    np.testing.assert_allclose(blade.pos, [-0.34, 0.0, 0.0])
    np.testing.assert_allclose(blade.size, [0.34, 0.01, 0.035])


def test_the_shield(armed: mujoco.MjModel) -> None:
    shield, disc = armed.body("shield"), armed.geom("shield")
    np.testing.assert_allclose(shield.pos, [0.0, 0.07, -0.12])
    assert shield.mass[0] == pytest.approx(2.1206, abs=5e-5)
    assert (shield.jntnum[0], disc.bodyid[0]) == (0, shield.id)
    np.testing.assert_allclose(disc.pos, [0.0, 0.015, 0.0])
    np.testing.assert_allclose(disc.size[:2], [0.3, 0.015])


def test_all_other_bodies_are_those_of_the_plain_humanoid(
    plain: mujoco.MjModel, armed: mujoco.MjModel
) -> None:
    for index in range(1, plain.nbody):
        ours, theirs = plain.body(index), armed.body(plain.body(index).name)
        for key in ("pos", "quat", "mass", "inertia", "ipos"):
            np.testing.assert_array_equal(
                getattr(ours, key), getattr(theirs, key), err_msg=f"{key} of {ours.name}"
            )
    for index in range(plain.ngeom):
        ours, theirs = plain.geom(index), armed.geom(plain.geom(index).name)
        for key in ("type", "size", "pos", "quat", "condim", "friction"):
            np.testing.assert_array_equal(
                getattr(ours, key), getattr(theirs, key), err_msg=f"{key} of {ours.name}"
            )


def test_gains_efforts_and_armature_are_those_of_ase(armed: mujoco.MjModel) -> None:
    first = 0
    for joint, size, kp, kd, armature, effort in ASE_DRIVES:
        dofs = slice(first, first + size)
        assert (armed.actuator_trnid[dofs, 0] == armed.joint(joint).id).all(), joint
        np.testing.assert_allclose(armed.actuator_gainprm[dofs, 0], kp, err_msg=joint)
        bias = [[0.0, -kp, -kd]] * size
        np.testing.assert_allclose(armed.actuator_biasprm[dofs, :3], bias, err_msg=joint)
        efforts = [[-effort, effort]] * size
        np.testing.assert_allclose(armed.actuator_forcerange[dofs], efforts, err_msg=joint)
        in_qvel = slice(6 + first, 6 + first + size)
        np.testing.assert_allclose(armed.dof_armature[in_qvel], armature, err_msg=joint)
        first += size
    assert first == armed.nu == armed.nv - 6 == 31
    assert (armed.jnt_stiffness == 0.0).all()
    assert (armed.dof_damping == 0.0).all()
