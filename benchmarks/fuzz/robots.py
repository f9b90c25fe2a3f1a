"""Robots' files that `benchmarks.fuzz` breaks: MJCF and URDF, meshes, mappings of their bodies."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from benchmarks.fuzz.kinds import Kind
from benchmarks.fuzz.mutators import mutate_bytes, mutate_text
from isaacgymenvs_lite import paths
from isaacgymenvs_lite.motion.retargeting.robot_mapping import load_robot_mapping
from isaacgymenvs_lite.robots.load import load_robot

_CORNERS = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], dtype=np.float32)
_TRIANGLES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
_MJCF = """<mujoco model="robot">
  <compiler angle="radian" meshdir="."/>
  <default><joint damping="0.1"/><default class="leg"><geom rgba="1 0 0 1"/></default></default>
  <asset>
    <mesh name="part" file="part.stl" scale="1 1 1"/>
    <mesh name="own" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/>
    <texture name="grid" type="2d" builtin="checker" width="8" height="8"/>
    <material name="grid" texture="grid"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="base" pos="0 0 1"><freejoint/>
      <geom type="mesh" mesh="part" material="grid"/>
      <replicate count="3" euler="0 0 2.094">
        <body name="thigh" pos="0.1 0 0" childclass="leg">
          <joint name="hip" axis="0 1 0" range="-1 1"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.03"/>
          <body name="foot" pos="0 0 -0.2" euler="0 0.1 0">
            <joint name="knee" type="ball" range="0 1"/>
            <geom type="mesh" mesh="own"/><site name="sole"/>
          </body>
        </body>
      </replicate>
    </body>
  </worldbody>
  <tendon><fixed name="coupling"><joint joint="hip0" coef="1"/></fixed></tendon>
  <equality><joint joint1="hip0" joint2="hip1" polycoef="0 1 0 0 0"/></equality>
  <actuator><position joint="hip0" kp="20" ctrlrange="-1 1"/><motor joint="hip1"/></actuator>
  <keyframe><key name="home" qpos="0 0 1 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1 0 0 0"/></keyframe>
</mujoco>
"""
_INERTIA = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
_URDF = f"""<?xml version="1.0"?>
<robot name="robot">
  <link name="base"><inertial><mass value="2"/>{_INERTIA}</inertial>
    <collision><geometry><mesh filename="package://robot/part.stl" scale="1 1 1"/></geometry>
    </collision></link>
  <link name="left"><inertial><mass value="1"/>{_INERTIA}</inertial>
    <collision><origin xyz="0 0 -0.1" rpy="0 0 0"/>
      <geometry><cylinder radius="0.02" length="0.2"/></geometry></collision></link>
  <link name="right"><inertial><mass value="1"/>{_INERTIA}</inertial>
    <visual><geometry><box size="0.1 0.1 0.2"/></geometry></visual>
    <collision><geometry><sphere radius="0.03"/></geometry></collision></link>
  <joint name="left_hip" type="revolute"><parent link="base"/><child link="left"/>
    <origin xyz="0 0.1 0"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="7" velocity="3"/></joint>
  <joint name="right_hip" type="continuous"><parent link="base"/><child link="right"/>
    <origin xyz="0 -0.1 0"/><axis xyz="0 1 0"/>
    <mimic joint="left_hip" multiplier="-1"/></joint>
</robot>
"""
_ENTITIES = (
    '<!DOCTYPE mujoco [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">'
    '<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;"><!ENTITY d "&c;&c;&c;&c;&c;&c;&c;&c;&c;&c;">]>'
    '<mujoco model="&d;"/>'
)


def _stl() -> bytes:
    """Return a tetrahedron as a binary STL."""
    triangles = [struct.pack("<12fH", 0, 0, 0, *_CORNERS[t].ravel(), 0) for t in _TRIANGLES]
    return bytes(80) + struct.pack("<I", len(triangles)) + b"".join(triangles)


def _obj() -> str:
    corners = ["v " + " ".join(f"{value:g}" for value in corner) for corner in _CORNERS]
    faces = ["f " + " ".join(str(index + 1) for index in t) for t in _TRIANGLES]
    return "\n".join((*corners, *faces, ""))


def _write_mjcf(folder: Path) -> list[Path]:
    (folder / "part.stl").write_bytes(_stl())
    (folder / "robot.xml").write_text(_MJCF, encoding="utf-8")
    quadruped = (paths.assets_dir() / "mjcf/quadruped.xml").read_text(encoding="utf-8")
    (folder / "quadruped.xml").write_text(quadruped, encoding="utf-8")
    return [folder / "robot.xml", folder / "quadruped.xml"]


def _write_urdf(folder: Path) -> list[Path]:
    package = folder / "robot"
    package.mkdir()
    (package / "part.stl").write_bytes(_stl())
    (folder / "robot.urdf").write_text(_URDF, encoding="utf-8")
    return [folder / "robot.urdf"]


def _write_stl(folder: Path) -> list[Path]:
    (folder / "part.stl").write_bytes(_stl())
    return [folder / "part.stl"]


def _write_obj(folder: Path) -> list[Path]:
    (folder / "part.obj").write_text(_obj(), encoding="utf-8")
    return [folder / "part.obj"]


def _load_with_mesh(path: Path) -> object:
    """Read a robot whose only shape is the mesh at `path`."""
    robot = path.parent / "of_mesh.xml"
    text = f"""<mujoco><asset><mesh name="part" file="{path.name}"/></asset><worldbody>
    <body><freejoint/><geom size="0.1"/><body pos="0 0 -0.2"><joint/><geom type="mesh" mesh="part"/>
    </body></body></worldbody></mujoco>"""
    robot.write_text(text, encoding="utf-8")
    try:
        return load_robot(robot)
    finally:
        robot.unlink()


def _write_mapping(folder: Path) -> list[Path]:
    shipped = paths.assets_dir() / "retargeting/robots/g1.yaml"
    (folder / "g1.yaml").write_bytes(shipped.read_bytes())
    return [folder / "g1.yaml"]


_BODY = '<body><freejoint/><geom size="1"/><body><joint name="j"/><geom size="1"/></body></body>'
# What reaches for other files, runs code or takes much memory, if it could: beside a robot ...
_HOSTILE_SECTIONS = {
    "include_itself": '<include file="input.xml"/>',
    "include_elsewhere": '<include file="/etc/passwd"/>',
    "include_up": '<include file="../../../../etc/passwd"/>',
    **{
        f"{kind}_{number}": f'<asset><{kind} name="a" file="{file}"/></asset>'
        for kind in ("mesh", "texture", "hfield")
        for number, file in enumerate(("/dev/zero", "/proc/self/mem", "../" * 20 + "dev/zero"))
    },
    "plugin": '<extension><plugin plugin="a"/></extension>',
    "texture": '<asset><texture type="2d" builtin="flat" width="1e9" height="1e9"/></asset>',
    "picture": '<asset><texture type="2d" builtin="flat" width="65535" height="65535"/></asset>',
    "sphere": '<asset><mesh name="a" builtin="sphere" params="100000"/></asset>',
    "field": '<asset><hfield name="a" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>',
    "memory": '<size memory="1000G" njmax="2000000000" nconmax="2000000000"/>',
    "user_data": '<size nuser_body="2000000000" nuserdata="2000000000"/>',
    "custom": '<custom><numeric name="a" size="2000000000"/></custom>',
    "states": '<actuator><general joint="j" actdim="2000000000" dyntype="user"/></actuator>',
    "delay": '<actuator><motor joint="j" nsample="2000000000" delay="1e9"/></actuator>',
    "textures": "<asset>"
    + '<texture type="2d" builtin="flat" width="4096" height="4096"/>' * 200
    + "</asset>",
    "cubes": '<asset><texture builtin="flat" width="4096" height="1"/></asset>' * 200,
    "meshes": "<asset>" + '<mesh builtin="supersphere" params="200 1 1"/>' * 200 + "</asset>",
    "actuators": "<actuator>" + '<motor joint="j"/>' * 20_000 + "</actuator>",
    "keys": "<keyframe>" + "<key/>" * 40_000 + "</keyframe>",
    "classes": "<default>" + '<default class="a"/>' * 40_000 + "</default>",
    "key": '<keyframe><key qpos="nan nan nan nan nan nan nan nan"/></keyframe>',
}
# ... and in its place.
_HOSTILE_WORLDS = {
    "nothing": "",
    "deep": "<body>" * 10_000 + "</body>" * 10_000,
    "wide": '<body><joint/><geom size="1"/></body>' * 20_000,
    "cameras": "<camera/>" * 40_000,
    "lights": "<light/>" * 40_000,
    "many": '<body><joint/><geom size="1"/></body>' * 15_000,
    "copies": f'<replicate count="1000000">{_BODY}</replicate>',
    "many_copies": f'<replicate count="1e18">{_BODY}</replicate>',
    "copies_of_many": f'<replicate count="500">{_BODY * 40}</replicate>',
    "copies_of_copies": '<replicate count="60">' * 6 + '<geom size="1"/>' + "</replicate>" * 6,
    "composite": '<body><composite type="grid" count="999 999 999"/></body>',
    "numbers": '<body pos="nan inf 1e308"><freejoint/><geom size="1e308"/></body>',
    "heavy": _BODY.replace("<joint", '<joint armature="1e308"').replace(
        "<geom", '<geom mass="9e99"'
    ),
    "control": '<body name="&#27;[31m"><joint/><geom size="1"/></body>',
}


def _hostile_mjcf(canary: Path) -> Iterable[tuple[str, bytes]]:
    yield "entities", _ENTITIES.encode()
    external = f'<!DOCTYPE mujoco [<!ENTITY a SYSTEM "file://{canary}">]><mujoco model="&a;"/>'
    yield "external", external.encode()
    yield "library", f'<mujoco><extension dll="{canary}"/></mujoco>'.encode()
    robot = "<mujoco{}>{}<worldbody>{}</worldbody></mujoco>"
    yield "name", robot.format(f' model="{"a" * 10**6}"', "", _BODY).encode()
    for name, section in _HOSTILE_SECTIONS.items():
        yield name, robot.format("", section, _BODY).encode()
    for name, world in _HOSTILE_WORLDS.items():
        yield name, robot.format("", "", world).encode()


def _hostile_urdf(canary: Path) -> Iterable[tuple[str, bytes]]:
    def link(name: object, shape: str = "") -> str:
        inertial = f'<inertial><mass value="1"/>{_INERTIA}</inertial>'
        return f'<link name="{name}">{inertial}{shape}</link>'

    def joint(name: str, parent: object, child: object, rest: str = "") -> str:
        ends = f'<parent link="{parent}"/><child link="{child}"/>'
        return f'<joint name="{name}" type="continuous">{ends}{rest}</joint>'

    def robot(*parts: str) -> bytes:
        return f'<robot name="a">{"".join(parts)}</robot>'.encode()

    a, b = link("a"), link("b")
    yield "entities", _ENTITIES.replace("mujoco", "robot").encode()
    yield "circle", robot(a, b, joint("j", "a", "b"), joint("k", "b", "a"))
    yield "itself", robot(a, joint("j", "a", "a"))
    yield "chain", robot(*(link(i) + joint(f"j{i}", i, i + 1) for i in range(5000)), link(5000))
    follow_each_other = [
        joint("j", "a", "b", '<mimic joint="k"/>'),
        joint("k", "a", "c", '<mimic joint="j"/>'),
    ]
    yield "mimics_in_a_circle", robot(a, b, link("c"), *follow_each_other)
    files = (f"file://{canary}", "package://../../etc/passwd", "/dev/zero", "http://a/b.stl")
    for number, file in enumerate(files):
        shape = f'<collision><geometry><mesh filename="{file}"/></geometry></collision>'
        yield f"mesh_{number}", robot(link("a", shape), b, joint("j", "a", "b"))


def _hostile_stl(canary: Path) -> Iterable[tuple[str, bytes]]:
    del canary  # the format cannot name code
    for count in (0, 1, 2**31, 2**32 - 1):
        yield f"count_{count}", bytes(80) + struct.pack("<I", count) + _stl()[84:]
    yield "nan", _stl()[:96] + struct.pack("<3f", *[float("nan")] * 3) + _stl()[108:]
    yield "huge", _stl()[:96] + struct.pack("<3f", 3e38, 3e38, -3e38) + _stl()[108:]
    yield "ascii", b"solid a\n" + b"facet normal 0 0 0\n" * 100_000
    yield "flat", bytes(80) + struct.pack("<I", 1000) + bytes(50_000)


KINDS = (
    Kind("robot_mjcf", ".xml", _write_mjcf, load_robot, mutate_text, _hostile_mjcf),
    Kind("robot_urdf", ".urdf", _write_urdf, load_robot, mutate_text, _hostile_urdf),
    # Errors of MuJoCo's name the mesh, not its file.
    Kind(
        "robot_stl",
        ".stl",
        _write_stl,
        _load_with_mesh,
        mutate_bytes,
        _hostile_stl,
        names_file=False,
    ),
    Kind("robot_obj", ".obj", _write_obj, _load_with_mesh, mutate_text, names_file=False),
    Kind("robot_mapping", ".yaml", _write_mapping, load_robot_mapping, mutate_text),
)
