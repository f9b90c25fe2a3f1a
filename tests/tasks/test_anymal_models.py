"""ANYmal's two models against the tables of their URDFs, fixed joints merged."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.paths import assets_dir

LEGS = ("LF", "LH", "RF", "RH")
BODIES = ["base", *(f"{leg}_{link}" for leg in LEGS for link in ("HIP", "THIGH", "SHANK"))]
JOINTS = [f"{leg}_{joint}" for leg in LEGS for joint in ("HAA", "HFE", "KFE")]
DEFAULT_ANGLES = np.array(
    [0.03, 0.4, -0.8, 0.03, -0.4, 0.8, -0.03, 0.4, -0.8, -0.03, -0.4, 0.8],
)
# Legs LF and RH are the same, and so are LH and RF. Mass (kg), center of mass (m), inertia about it
# (kg m^2): xx yy zz xy xz yz.
INERTIALS = {
    "anymal": {
        "base": (
            40.9892,
            (-0.011449, -0.000115, 0.005472),
            (0.28073, 2.238, 2.2703, 0.009194, 0.060356, -0.00014953),
        ),
        "LF_HIP RH_HIP": (
            2.781,
            (0.056661, -0.015294, -0.008298),
            (0.0032955, 0.0050443, 0.0057269, -1.0388e-05, 0.00010706, -0.00031949),
        ),
        "LH_HIP RF_HIP": (
            2.781,
            (0.056763, 0.015294, -0.008298),
            (0.0032955, 0.0050462, 0.0057287, -1.1005e-05, -0.00010912, 0.00031949),
        ),
        "LF_THIGH RH_THIGH": (
            3.071,
            (0.030815, 4.6e-05, -0.245696),
            (0.029564, 0.029904, 0.0048611, 4.4292e-05, 0.0041424, 9.448e-05),
        ),
        "LH_THIGH RF_THIGH": (
            3.071,
            (0.030815, 4.6e-05, -0.245696),
            (0.029564, 0.029904, 0.0048611, 4.4396e-05, 0.0041424, 0.00011479),
        ),
        "LF_SHANK RH_SHANK": (
            0.58842,
            (0.005462, -0.061253, -0.08066),
            (0.010161, 0.0088104, 0.0015498, -5.3571e-05, -2.266e-05, -0.0018194),
        ),
        "LH_SHANK RF_SHANK": (
            0.58842,
            (0.005462, 0.061253, -0.08066),
            (0.010161, 0.0088104, 0.0015498, 5.3571e-05, -2.266e-05, 0.0018194),
        ),
    },
    "anymal_minimal": {
        "base": (
            27.8029,
            (-0.019068, 0.006209, 0.010012),
            (0.19843, 1.3798, 1.4285, 0.0029488, 0.052055, -0.0018674),
        ),
        "LF_HIP RH_HIP": (
            2.51203,
            (0.05625, -0.011578, -0.005842),
            (0.0049235, 0.0063342, 0.0070792, 9.9477e-05, 7.8448e-05, -0.00069618),
        ),
        "LH_HIP RF_HIP": (
            2.51203,
            (0.056356, 0.011578, -0.005842),
            (0.0049235, 0.0063361, 0.0070811, -8.9674e-05, 7.2909e-05, 0.00069618),
        ),
        "LF_THIGH RH_THIGH": (
            3.27327,
            (0.020484, 0.003964, -0.224807),
            (0.043373, 0.046201, 0.0094165, -0.00086158, 0.0058063, -0.0028893),
        ),
        "LH_THIGH RF_THIGH": (
            3.27327,
            (0.020484, -0.003883, -0.224807),
            (0.043375, 0.046201, 0.0094186, 0.00087046, 0.0058063, 0.0029054),
        ),
        "LF_SHANK RH_SHANK": (
            0.55505,
            (0.005576, -0.059078, -0.074016),
            (0.0096828, 0.0083782, 0.0015034, -5.115e-05, -1.5264e-05, -0.0016779),
        ),
        "LH_SHANK RF_SHANK": (
            0.55505,
            (0.005576, 0.059078, -0.074016),
            (0.0096828, 0.0083782, 0.0015034, 5.115e-05, -1.5264e-05, 0.0016779),
        ),
    },
}
TOTAL_MASS = {"anymal": 66.751, "anymal_minimal": 53.164}


@pytest.fixture(params=sorted(INERTIALS))
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def model(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(assets_dir() / "mjcf" / f"{name}.xml"))


def _standing(model: mujoco.MjModel, height: float = 0.0) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:3] = 0.0, 0.0, height
    data.qpos[7:] = DEFAULT_ANGLES
    mujoco.mj_forward(model, data)
    return data


def test_bodies_and_joints_stand_in_the_order_of_the_actions(model: mujoco.MjModel) -> None:
    assert [model.body(i).name for i in range(1, model.nbody)] == BODIES
    assert [model.joint(i).name for i in range(1, model.njnt)] == JOINTS
    assert [model.actuator(i).name for i in range(model.nu)] == JOINTS
    assert model.actuator_trnid[:, 0].tolist() == list(range(1, 13))
    assert [model.sensor(i).name for i in range(model.nsensor)] == [f"contact_{b}" for b in BODIES]


def test_masses_centers_and_inertias(model: mujoco.MjModel, name: str) -> None:
    assert model.body_mass.sum() == pytest.approx(TOTAL_MASS[name], abs=1e-3)
    for bodies, (mass, center, inertia) in INERTIALS[name].items():
        for body_name in bodies.split():
            body = model.body(body_name)
            assert body.mass[0] == pytest.approx(mass)
            assert body.ipos.tolist() == pytest.approx(center)
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, body.iquat)
            rotation = rotation.reshape(3, 3)
            full = rotation @ np.diag(body.inertia) @ rotation.T
            given = full[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            # MuJoCo keeps the diagonal form; its way there and back costs a few digits of 1e-9.
            assert given == pytest.approx(inertia, abs=1e-8), body_name


def test_feet_at_the_default_angles(model: mujoco.MjModel) -> None:
    data = _standing(model)
    for leg in LEGS:
        expected = [
            0.45267 if leg[1] == "F" else -0.45267,
            0.31663 if leg[0] == "L" else -0.31663,
            -0.51267,
        ]
        assert data.geom(f"{leg}_foot").xpos.tolist() == pytest.approx(expected, abs=1e-5)


def test_hinges_turn_as_in_the_urdf(model: mujoco.MjModel) -> None:
    """A rise of any HAA swings its leg outwards on the left, and inwards on the right."""
    axes = [model.joint(joint).axis[0] for joint in JOINTS]
    assert axes == [1, 1, 1, -1, 1, 1, 1, -1, -1, -1, -1, -1]
    before = _standing(model)
    for leg in LEGS:
        data = _standing(model)
        data.joint(f"{leg}_HAA").qpos += 0.1
        mujoco.mj_kinematics(model, data)
        moved = data.geom(f"{leg}_foot").xpos - before.geom(f"{leg}_foot").xpos
        assert moved[1] > 0.03, leg


def test_limits(model: mujoco.MjModel, name: str) -> None:
    if name == "anymal_minimal":
        assert not model.jnt_limited.any()
        return
    for leg in LEGS:
        low, high = (-0.72, 0.49) if leg[0] == "L" else (-0.49, 0.72)
        assert model.joint(f"{leg}_HAA").range.tolist() == pytest.approx([low, high])
        assert model.joint(f"{leg}_KFE").range.tolist() == pytest.approx([-9.42478, 9.42478])


def test_feet_touch_the_floor_at_0_543_m(model: mujoco.MjModel) -> None:
    assert _standing(model, 0.5431).ncon == 0
    data = _standing(model, 0.542)
    touching = {model.geom(contact.geom2).name for contact in data.contact}
    assert touching == {f"{leg}_foot" for leg in LEGS}
    assert (data.contact.dim == 3).all()


def test_parts_touch_each_other_in_the_minimal_model_only(model: mujoco.MjModel, name: str) -> None:
    data = _standing(model, 5.0)
    # The left front leg reaches back.
    for joint, angle in (("LF_HAA", -0.35), ("LF_HFE", 0.82), ("LF_KFE", 1.05)):
        data.joint(joint).qpos[0] = angle
    mujoco.mj_forward(model, data)
    pairs = {frozenset((model.geom(c.geom1).name, model.geom(c.geom2).name)) for c in data.contact}
    assert pairs == ({frozenset(("LF_foot", "LH_knee"))} if name == "anymal_minimal" else set())
    assert (data.contact.dim == 1).all()
