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


def test_contact_columns_of_some_bodies() -> None:
    columns = _layout(ROBOT % _contact_sensors("upper", "finger")).contact_columns
    assert columns is not None
    np.testing.assert_array_equal(columns[[1, 4]], np.arange(6).reshape(2, 3))
    assert (columns[[0, 2, 3]] == -1).all()


# The robot above (5 bodies, qpos 0:13, qvel 0:11), then two objects.
OBJECTS = """
<body name="box" pos="1 0 1"><freejoint name="box_joint"/><geom size="0.1"/></body>
<body name="ball" pos="2 0 1"><joint type="free"/><geom size="0.1"/></body>
"""
WITH_OBJECTS = ROBOT.replace("</worldbody>", OBJECTS + "</worldbody>")


def test_objects_are_apart_from_the_robot() -> None:
    layout, alone = _layout(WITH_OBJECTS % ""), _layout(ROBOT % "")
    assert layout.object_names == ("box", "ball")
    assert alone.object_names == ()
    assert layout.body_names == alone.body_names
    assert layout.dof_names == alone.dof_names
    assert layout.dof_body_ids == alone.dof_body_ids
    assert layout.dof_offsets == alone.dof_offsets
    for each in (layout, alone):
        assert (each.num_dofs, each.num_qpos, each.num_qvel) == (5, 13, 11)


def test_an_object_beside_a_robot_on_a_fixed_base() -> None:
    layout = _layout(
        '<mujoco><worldbody><body name="arm"><joint name="j"/><geom size="0.1"/></body>'
        '<body name="box"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    assert (layout.body_names, layout.object_names) == (("arm",), ("box",))
    assert (layout.has_free_root, layout.num_qpos, layout.num_qvel) == (False, 1, 1)
    assert layout.dof_vel_adr == 0
    np.testing.assert_array_equal(layout.scalar_qpos, [0])


def test_contact_columns_of_objects() -> None:
    bodies = ("base", "upper", "lower", "plate", "finger")
    layout = _layout(WITH_OBJECTS % _contact_sensors(*bodies, "box", "ball"))
    np.testing.assert_array_equal(layout.contact_columns, np.arange(15).reshape(5, 3))
    np.testing.assert_array_equal(layout.object_contact_columns, [[15, 16, 17], [18, 19, 20]])
    # Objects may have sensors where bodies have none, and the other way round.
    layout = _layout(WITH_OBJECTS % _contact_sensors(*bodies))
    assert layout.object_contact_columns is None
    layout = _layout(WITH_OBJECTS % _contact_sensors("box", "ball"))
    assert layout.contact_columns is None
    np.testing.assert_array_equal(layout.object_contact_columns, np.arange(6).reshape(2, 3))


BOX = '<body name="box"><freejoint/><geom size="0.1"/>%s</body>'
ARM = '<body name="arm"><joint/><geom size="0.1"/></body>'


def test_free_bodies_that_are_no_objects_are_refused() -> None:
    lid = BOX.replace("box", "lid") % ""
    for bodies, message in (
        (ARM + BOX % "" + ARM.replace("arm", "leg"), "'box' comes before body 'leg'.*to the end"),
        (ARM + BOX % "" + lid + '<body name="wall"/>', "'box' comes before body 'wall'"),
        (
            BOX.replace("box", "robot") % ARM + BOX % '<body name="lid"/>',
            "'box' has a free joint and a child, 'lid'.*at most one robot",
        ),
    ):
        with pytest.raises(ConfigError, match=message):
            _layout(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")


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
