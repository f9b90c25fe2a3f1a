from __future__ import annotations

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.simulation.model_layout import ModelLayout

# A free base (qpos 0:7, qvel 0:6) with a hinge, then a ball joint, then a slide:
# qpos 7, 8:12, 12; DOFs 0, 1:4, 4.
ROBOT = """
<mujoco><worldbody>
  <body name="base"><freejoint/><geom size="0.1"/>
    <body name="upper"><joint name="knee" type="hinge"/><geom size="0.1"/>
      <body name="lower"><joint name="ankle" type="ball"/><geom size="0.1"/></body>
    </body>
    <body name="plate"><geom size="0.1"/></body>
    <body name="finger"><joint name="grip" type="slide"/><geom size="0.1"/></body>
  </body>
</worldbody>%s</mujoco>
"""


def _layout(mjcf: str) -> ModelLayout:
    return ModelLayout.from_model(mujoco.MjModel.from_xml_string(mjcf))


def _contact_sensors(*bodies: str) -> str:
    lines = [
        f'<contact name="contact_{body}" body1="{body}" data="force" reduce="netforce"/>'
        for body in bodies
    ]
    return f"<sensor>{''.join(lines)}</sensor>"


def test_names_and_addresses_by_hand() -> None:
    layout = _layout(ROBOT % "")
    assert layout.body_names == ("base", "upper", "lower", "plate", "finger")
    assert layout.dof_names == ("knee", "ankle_x", "ankle_y", "ankle_z", "grip")
    assert layout.dof_body_ids == (1, 2, 4)
    assert layout.dof_offsets == (0, 1, 4, 5)
    assert layout.num_dofs == 5
    assert layout.has_free_root
    assert layout.dof_vel_adr == 6
    # xyzw columns: MuJoCo stores w first
    np.testing.assert_array_equal(layout.ball_qpos, [[9, 10, 11, 8]])
    np.testing.assert_array_equal(layout.ball_dofs, [[1, 2, 3]])
    np.testing.assert_array_equal(layout.scalar_qpos, [7, 12])
    np.testing.assert_array_equal(layout.scalar_dofs, [0, 4])
    assert layout.contact_columns is None


def test_a_fixed_base_has_no_root_columns() -> None:
    layout = _layout(
        '<mujoco><worldbody><body name="a"><joint name="j" type="hinge"/><geom size="0.1"/></body>'
        "</worldbody></mujoco>"
    )
    assert not layout.has_free_root
    assert layout.dof_vel_adr == 0
    np.testing.assert_array_equal(layout.scalar_qpos, [0])


def test_contact_columns_are_found_by_name() -> None:
    bodies = ("base", "upper", "lower", "plate", "finger")
    columns = _layout(ROBOT % _contact_sensors(*bodies)).contact_columns
    assert columns is not None
    np.testing.assert_array_equal(columns, np.arange(15).reshape(5, 3))
    # Another sensor (3 numbers) before them moves all by three.
    other = '<sensor><subtreecom name="com" body="base"/></sensor>'
    columns = _layout(ROBOT % (other + _contact_sensors(*bodies))).contact_columns
    assert columns is not None
    np.testing.assert_array_equal(columns, 3 + np.arange(15).reshape(5, 3))


def test_contact_sensors_of_some_bodies_only_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"for some bodies but not '(contact_)?plate'"):
        _layout(ROBOT % _contact_sensors("base", "upper", "lower", "finger"))


def test_a_second_free_body_is_refused() -> None:
    with pytest.raises(ConfigError, match="'loose' is a free joint but not the first"):
        _layout(
            '<mujoco><worldbody><body name="a"><freejoint name="root"/><geom size="0.1"/></body>'
            '<body name="b"><freejoint name="loose"/><geom size="0.1"/></body>'
            "</worldbody></mujoco>"
        )


def test_the_humanoid_in_the_order_of_policies_and_motions(humanoid_model: mujoco.MjModel) -> None:
    layout = ModelLayout.from_model(humanoid_model)
    assert layout.body_names == (
        *("pelvis", "torso", "head"),
        *("right_upper_arm", "right_lower_arm", "right_hand"),
        *("left_upper_arm", "left_lower_arm", "left_hand"),
        *("right_thigh", "right_shin", "right_foot"),
        *("left_thigh", "left_shin", "left_foot"),
    )
    assert layout.dof_body_ids == (1, 2, 3, 4, 6, 7, 9, 10, 11, 12, 13, 14)
    assert layout.dof_offsets == (0, 3, 6, 9, 10, 13, 14, 17, 18, 21, 24, 25, 28)
    assert layout.dof_names == (
        *("abdomen_x", "abdomen_y", "abdomen_z", "neck_x", "neck_y", "neck_z"),
        *("right_shoulder_x", "right_shoulder_y", "right_shoulder_z", "right_elbow"),
        *("left_shoulder_x", "left_shoulder_y", "left_shoulder_z", "left_elbow"),
        *("right_hip_x", "right_hip_y", "right_hip_z", "right_knee"),
        *("right_ankle_x", "right_ankle_y", "right_ankle_z"),
        *("left_hip_x", "left_hip_y", "left_hip_z", "left_knee"),
        *("left_ankle_x", "left_ankle_y", "left_ankle_z"),
    )
    actuators = tuple(humanoid_model.actuator(i).name for i in range(humanoid_model.nu))
    assert actuators == layout.dof_names
