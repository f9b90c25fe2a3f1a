"""Robot files of strangers: what is read, and what is refused in one line."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.robots.reading import read_robot_file
from tests.robots.texts import INERTIAL, LEG, TETRAHEDRON, mjcf, urdf, written

MESH = '<asset><mesh file="{}"/></asset>'

CORNER_STL = """solid corner of a cube
facet normal 0 0 -1
outer loop
vertex 0 0 0
vertex 0 1 0
vertex 1 0 0
endloop
endfacet
facet normal 0 -1 0
outer loop
vertex 0 0 0
vertex 1.0e0 0 0
vertex 0 0 1
endloop
endfacet
facet normal -1 0 0
outer loop
vertex 0 0 0
vertex 0 0 1
vertex 0 1 0
endloop
endfacet
facet normal 1 1 1
outer loop
vertex 1 0 0
vertex 0 1 0
vertex 0 0 1
endloop
endfacet
endsolid
"""


def refusal(path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        read_robot_file(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


def test_mjcf_with_include_and_mesh(tmp_path):
    written(tmp_path / "parts/tet.obj", TETRAHEDRON)
    written(tmp_path / "parts/leg.xml", "<mujocoinclude><option impratio='7'/></mujocoinclude>")
    leg = '<body><joint axis="1 0 0"/><geom type="mesh" mesh="tet"/></body>'
    rest = '<include file="parts/leg.xml"/><compiler meshdir="parts"/>' + MESH.format("tet.obj")
    model = read_robot_file(
        written(tmp_path / "robot.xml", mjcf(leg=leg, rest=rest))
    ).spec.compile()
    assert model.opt.impratio == 7
    assert model.nmesh == 1
    assert model.mesh_vertnum[0] == 4


@pytest.mark.parametrize(
    "places",
    [("parts/sub/y.xml",), ("y.xml", "parts/sub/y.xml"), ("parts/y.xml",)],
)
def test_includes_of_includes_are_found_where_mujoco_finds_them(tmp_path, places):
    """Beside the main file, else beside the file that includes, not beside the one before that."""
    path = written(tmp_path / "robot.xml", mjcf(rest='<include file="parts/x.xml"/>'))
    written(tmp_path / "parts/x.xml", '<mujoco><include file="sub/x.xml"/></mujoco>')
    nested = '<body pos="0 0 5"><include file="y.xml"/></body>'
    written(tmp_path / "parts/sub/x.xml", f"<mujoco><worldbody>{nested}</worldbody></mujoco>")
    for i, place in enumerate(places):
        written(tmp_path / place, f'<mujocoinclude><geom size=".{i + 1}"/></mujocoinclude>')
    try:
        theirs = mujoco.MjModel.from_xml_path(str(path))
    except ValueError:
        assert '<include file="y.xml"> is missing; looked for' in refusal(path)
    else:
        np.testing.assert_array_equal(
            read_robot_file(path).spec.compile().geom_size, theirs.geom_size
        )


@pytest.mark.parametrize(
    ("uri", "place"),
    [
        ("package://my_robot/meshes/a.obj", "ws/my_robot/meshes/a.obj"),
        ("package://other/meshes/a.obj", "ws/other/meshes/a.obj"),
        ("package://my_robot/meshes/a.dae", "ws/my_robot/meshes/a.obj"),
        ("package://elsewhere/meshes/a.obj", "ws/my_robot/meshes/a.obj"),
        ("../meshes/a.obj", "ws/my_robot/meshes/a.obj"),
    ],
)
def test_meshes_of_urdf_files(tmp_path, uri, place):
    written(tmp_path / place, TETRAHEDRON)
    path = tmp_path / "ws/my_robot/urdf/robot.urdf"
    written(path, urdf(f'<mesh filename="{uri}" scale="2 2 2"/>'))
    assert read_robot_file(path).spec.compile().nmesh == 1


def test_stl_files_in_ascii_have_the_volume_of_their_triangles(tmp_path):
    written(tmp_path / "a.stl", CORNER_STL)
    model = read_robot_file(
        written(tmp_path / "r.urdf", urdf('<mesh filename="a.stl"/>'))
    ).spec.compile()
    vertices = model.mesh_vert + model.mesh_pos[0]  # about the centre of mass, along main axes
    assert model.mesh_vertnum[0] == 4
    # A corner of a cube of side 1 m: three edges of 1 m, three of sqrt(2).
    edges = sorted(float(np.linalg.norm(a - b)) for a, b in combinations(vertices, 2))
    assert edges == pytest.approx([1, 1, 1, *3 * [2**0.5]], abs=1e-6)


def test_a_robot_that_only_shows_itself_collides_as_it_looks(tmp_path):
    text = urdf().replace("collision>", "visual>")
    robot = read_robot_file(written(tmp_path / "r.urdf", text))
    assert any("visual shapes collide" in note for note in robot.notes)
    model = robot.spec.compile()
    assert model.geom_contype.all()


def test_open_meshes_of_links_with_inertias(tmp_path):
    corners, _, _ = TETRAHEDRON.partition("f")
    written(tmp_path / "a.obj", f"{corners}f 1 3 2\n")  # one side: no volume
    path = written(tmp_path / "r.urdf", urdf('<mesh filename="a.obj"/>'))
    assert read_robot_file(path).spec.compile().nmesh == 1
    path = written(tmp_path / "s.urdf", urdf('<mesh filename="a.obj"/>').replace(INERTIAL, "", 1))
    with pytest.raises(ValueError, match="volume"):  # the inertia is to come from it
        read_robot_file(path).spec.compile()


def test_inertias_that_no_solid_has_become_positive(tmp_path):
    odd = 'ixx="1" iyy="1" izz="1" ixy="0" ixz="2" iyz="0"'
    text = urdf().replace('ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"', odd)
    robot = read_robot_file(written(tmp_path / "r.urdf", text))
    assert any("repaired inertias" in note for note in robot.notes)
    # Moments 3, 1, -1; 3, 1, 0 are of no solid either, which MuJoCo balances to their mean.
    assert robot.spec.compile().body_inertia[-1] == pytest.approx([4 / 3] * 3, rel=1e-6)


def test_missing_mesh_is_named_with_the_places_searched(tmp_path):
    path = written(tmp_path / "r.urdf", urdf('<mesh filename="package://me/meshes/a.stl"/>'))
    message = refusal(path)
    assert "package://me/meshes/a.stl" in message
    assert str(tmp_path / "meshes/a.stl") in message


def test_meshes_that_mujoco_does_not_read(tmp_path):
    message = refusal(written(tmp_path / "r.urdf", urdf('<mesh filename="a.dae"/>')))
    assert "a.dae" in message
    assert ".stl, .obj, .msh" in message
    both = '<box size="1 1 1"/></geometry></collision><visual><geometry><mesh filename="a.dae"/>'
    text = urdf(both).replace('"a.dae"/></geometry></collision>', '"a.dae"/></geometry></visual>')
    robot = read_robot_file(written(tmp_path / "s.urdf", text))
    assert robot.notes[0].startswith("left out 1 visual mesh")
    assert next(geom.type for geom in robot.spec.geoms) == mujoco.mjtGeom.mjGEOM_BOX


def test_includes_from_outside_are_refused(tmp_path):
    secret = written(tmp_path / "secret.xml", "<mujocoinclude/>")
    folder = tmp_path / "robot"
    (folder / "a").mkdir(parents=True)
    (folder / "link.xml").symlink_to(secret)
    for name in ("/etc/passwd", "../secret.xml", "link.xml", "a/../../secret.xml"):
        path = written(folder / "r.xml", mjcf(rest=f'<include file="{name}"/>'))
        assert "outside of the robot's folder" in refusal(path)


def test_meshes_from_outside_are_refused(tmp_path):
    secret = written(tmp_path / "x.stl", "solid")
    folder = tmp_path / "robot"
    folder.mkdir()
    (folder / "link.stl").symlink_to(secret)
    for name in ("/etc/x.stl", "../x.stl", "link.stl", "package://x/../../x.stl"):
        for text in (mjcf(rest=MESH.format(name)), urdf(f'<mesh filename="{name}"/>')):
            message = refusal(written(folder / "r.xml", text))
            assert "outside of the robot's folder" in message or "is missing" in message


def test_texts_that_cannot_be_used_are_refused_in_one_line(tmp_path):
    for text, reason in (
        ("<sdf/>", "begins with <sdf>"),
        ("\x7fELF\x00", "not valid XML"),
        (mjcf(rest='<extension><plugin plugin="mujoco.sdf.bolt"/></extension>'), "plugins"),
        (mjcf(rest='<asset><model file="a.xml"/></asset>'), "models within models"),
        (mjcf(world='<body><flexcomp name="a" count="9 9 9"/></body>'), "soft bodies"),
        (mjcf(world='<body><geom size="1" pos="a b c"/></body>'), "MuJoCo cannot read it"),
        (urdf('<sphere radius="large"/>'), "could not convert"),
    ):
        assert reason in refusal(written(tmp_path / "r.xml", text))


def test_a_plugin_in_an_included_file_is_refused(tmp_path):
    plugin = (
        '<mujocoinclude><extension><plugin plugin="mujoco.sdf.bolt"/></extension></mujocoinclude>'
    )
    written(tmp_path / "parts/b.xml", plugin)
    written(tmp_path / "parts/a.xml", '<mujocoinclude><include file="b.xml"/></mujocoinclude>')
    path = written(tmp_path / "r.xml", mjcf(rest='<include file="parts/a.xml"/>'))
    assert "plugins are not loaded" in refusal(path)


def test_missing_files(tmp_path):
    assert "no such file" in refusal(tmp_path / "none.xml")
    assert "no such file" in refusal(tmp_path)


def test_includes_that_include_each_other(tmp_path):
    written(tmp_path / "a.xml", '<mujocoinclude><include file="b.xml"/></mujocoinclude>')
    written(tmp_path / "b.xml", '<mujocoinclude><include file="a.xml"/></mujocoinclude>')
    message = refusal(written(tmp_path / "r.xml", mjcf(rest='<include file="a.xml"/>')))
    assert "already included" in message


def test_what_a_robot_does_not_need_is_left_out(tmp_path):
    element = '<element objtype="body" objname="base"/>'
    rest = f"""<size memory="1K" nkey="1"/><custom><tuple name="t">{element}</tuple></custom>
    <statistic meaninertia="9"/><sensor><user dim="3"/></sensor>"""
    robot = read_robot_file(written(tmp_path / "r.xml", mjcf(rest=rest)))
    model = robot.spec.compile()
    assert model.nsensordata == model.ntuple == model.nkey == 0
    assert model.stat.meaninertia < 9
    assert robot.notes == ("left out of the file: 1 sensors",)


def test_textures_that_are_no_png_of_the_robot_are_left_out(tmp_path):
    rest = """<asset><texture type="2d" name="t" file="t.jpg"/>
    <texture type="2d" name="u" file="none.png"/><material name="m" texture="t"/></asset>"""
    robot = read_robot_file(written(tmp_path / "r.xml", mjcf(rest=rest)))
    assert robot.spec.compile().ntex == 0
    assert "t, u" in robot.notes[0]


def test_materials_that_the_file_does_not_define_are_left_out(tmp_path):
    leg = LEG.replace("<geom", '<geom material="geom"')
    robot = read_robot_file(written(tmp_path / "r.xml", mjcf(leg=leg)))
    robot.spec.compile()
    assert robot.notes == ("left out materials that the file does not define: geom",)
