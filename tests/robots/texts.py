"""Small robots as texts, for the tests."""

from __future__ import annotations

from pathlib import Path

LEG = """
<body name="thigh" pos="0 0 -0.1"><joint name="hip" axis="0 1 0" range="-1 1"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.03"/>
  <body name="foot" pos="0 0 -0.2"><joint name="knee" axis="1 0 0" range="0.2 2"/>
    <geom type="sphere" size="0.05" pos="0 0 -0.1"/></body></body>
"""


def mjcf(base: str = "<freejoint/>", world: str = "", rest: str = "", leg: str = LEG) -> str:
    """Return a robot of a box (1 m above the floor) and a leg, angles in rad."""
    return f"""<mujoco model="hopper"><compiler angle="radian"/><worldbody>{world}
    <body name="base" pos="0 0 1">{base}<geom type="box" size="0.1 0.1 0.1" mass="2"/>{leg}</body>
    </worldbody>{rest}</mujoco>"""


INERTIAL = (
    '<inertial><mass value="1"/>'
    '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def urdf(shape: str = '<box size="0.2 0.2 0.2"/>', rest: str = "", kind: str = "collision") -> str:
    """Return a robot of a base, an arm on a revolute and a fixed hand."""
    return f"""<?xml version="1.0"?><robot name="arm">
    <link name="base">{INERTIAL}<{kind}><geometry>{shape}</geometry></{kind}></link>
    <link name="arm">{INERTIAL}<collision><origin xyz="0.2 0 0"/>
      <geometry><cylinder radius="0.02" length="0.1"/></geometry></collision></link>
    <link name="hand">{INERTIAL}<collision><geometry><sphere radius="0.03"/></geometry></collision>
    </link>
    <joint name="shoulder" type="revolute"><parent link="base"/><child link="arm"/>
      <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="7" velocity="3"/></joint>
    <joint name="wrist" type="fixed"><parent link="arm"/><child link="hand"/>
      <origin xyz="0.4 0 0"/></joint>
    {rest}</robot>"""


TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def written(path: Path, text: str) -> Path:
    """Write a text, with the folders above it, and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path
