"""play_onnx.py: an exported policy moves its robot without this package as it does within it."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.export.export import scene_of
from isaacgymenvs_lite.export.exportable_policy import make_exportable_policy
from isaacgymenvs_lite.export.formats import FORMATS
from isaacgymenvs_lite.export.metadata import describe
from isaacgymenvs_lite.motion.clip import JointClip
from isaacgymenvs_lite.motion.formats.robot_clip import save_robot_npz
from tests.export.conftest import scramble
from tests.tiny import composed

pytest.importorskip("onnxruntime")
onnx = pytest.importorskip("onnx")

SCRIPT = Path(__file__).parents[2] / "play_onnx.py"
STEPS = 50
# Runs a script that can import its three packages, but none that only this project needs.
ALONE = """
import importlib.abc, runpy, sys
class Refuse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"isaacgymenvs_lite", "torch", "rl_games", "yaml", "onnx"}:
            raise ImportError(f"refused: {name}")
sys.meta_path.insert(0, Refuse())
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
# A trunk with a head on a ball joint and two legs on hinges.
ROBOT = """
<mujoco model="toy"><compiler angle="degree" meshdir="meshes"/>
<asset><mesh file="nose.obj"/></asset><worldbody>
<body name="trunk" pos="0 0 .5"><geom type="box" size=".15 .1 .08" mass="5"/>
  <body name="head" pos=".2 0 .1"><joint name="neck" type="ball" range="0 100"/>
    <geom type="capsule" fromto="0 0 0 .15 0 .1" size=".04" mass="1"/>
    <geom type="mesh" mesh="nose" pos=".2 0 .1" mass=".2"/></body>
  <body name="left_leg" pos="0 .12 -.05"><joint name="left" axis="0 1 0" range="-80 80"/>
    <geom type="capsule" fromto="0 0 0 .05 0 -.3" size=".03" mass="1"/></body>
  <body name="right_leg" pos="0 -.12 -.05"><joint name="right" axis="1 0 0" range="-80 80"/>
    <geom type="capsule" fromto="0 0 0 -.05 0 -.3" size=".03" mass="1"/></body>
</body></worldbody>{more}</mujoco>
"""
DRIVE = "{kp: 32, kd: 3.2, effort: 10.7, armature: 0}"
NOSE = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    folder = tmp_path / "robots"
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes" / "nose.obj").write_text(NOSE)
    (folder / "toy.xml").write_text(ROBOT.format(more=""))
    return folder / "toy.xml"


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """A second on a curve, pitched, 0.6 m above the ground; all joints turn."""
    time_s = np.linspace(0.0, 1.0, 31)[:, None]
    yaw, pitch = 0.5 * (0.8 + time_s), 0.15  # halves of the angles
    axes = (-np.sin(yaw) * np.sin(pitch), np.cos(yaw) * np.sin(pitch), np.sin(yaw), np.cos(yaw))
    root_rot = np.hstack((*axes[:2], *(axis * np.cos(pitch) for axis in axes[2:])))
    root_pos = np.hstack((time_s, 0.2 * time_s, 0.6 + 0.1 * time_s))
    dof_pos = np.array([0.4, -0.3, 0.2, 0.3, -0.5]) + time_s * (0.5, 0.4, -0.6, 1.0, 0.7)
    names = ("neck_x", "neck_y", "neck_z", "left", "right")
    file = tmp_path / "curve.npz"
    save_robot_npz(file, JointClip("curve", 30.0, root_pos, root_rot, dof_pos, names))
    return file


@pytest.fixture
def make_player(make_runner: Callable[..., Any], robot: Path, clip: Path) -> Callable[..., Any]:
    """Return make(**env), a player of RobotAMP with the toy; episodes start as its clip does."""

    def make(**env: Any) -> Any:
        settings = {
            "asset.assetFileName": robot,
            "motion_file": clip,
            "stateInit": "Start",
            "enableEarlyTermination": False,
            "startPose": "{left: 0.3, right: -0.2}",
            "drives": "{" + ", ".join(f"{j}: {DRIVE}" for j in ("neck", "left", "right")) + "}",
            "actionScale": 0.3,
            "plane.dynamicFriction": 0.7,
            **env,
        }
        words = [f"task.env.{key}={value}" for key, value in settings.items()]
        player = make_runner("task=RobotAMP", *words, num_envs=2).create_player()
        scramble(player.model)
        return player

    return make


class Linear:
    """A policy of one layer, tanh(W obs), which is exported faster than a network of torch's."""

    def __init__(self, num_obs: int, num_actions: int) -> None:
        generator = torch.Generator().manual_seed(3)
        self.weights = 0.1 * torch.randn(num_obs, num_actions, generator=generator)

    def __call__(self, obs: Tensor) -> Tensor:
        return torch.tanh(obs @ self.weights)

    def onnx_file(self, metadata: dict[str, Any]) -> bytes:
        helper, kind = onnx.helper, onnx.TensorProto.FLOAT
        num_obs, num_actions = self.weights.shape
        graph = helper.make_graph(
            [
                helper.make_node("MatMul", ["obs", "W"], ["sum"]),
                helper.make_node("Tanh", ["sum"], ["action"]),
            ],
            "linear",
            [helper.make_tensor_value_info("obs", kind, ["batch", num_obs])],
            [helper.make_tensor_value_info("action", kind, ["batch", num_actions])],
            [onnx.numpy_helper.from_array(self.weights.numpy(), "W")],
        )
        opset = helper.make_opsetid("", 18)
        model = helper.make_model(graph, ir_version=10, opset_imports=[opset])
        texts = {k: v if isinstance(v, str) else json.dumps(v) for k, v in metadata.items()}
        helper.set_model_props(model, texts)
        return model.SerializeToString()


def metadata_of(player: Any) -> dict[str, Any]:
    return describe(composed(["task=RobotAMP"]), player, make_exportable_policy(player), {})


def write_scene(player: Any, policy: Path) -> Path:
    scene = scene_of(player.env, policy)
    assert scene is not None
    scene.write()
    return scene.path


def played_by_the_task(task: Any, act: Callable[[Tensor], Tensor]) -> npt.NDArray[np.float64]:
    """Coordinates qpos (STEPS + 1, Q) of an environment, at first and after each control step."""
    obs = task.reset()["obs"]
    rows = [task.simulation.batch.bind("qpos")[0].copy()]
    for _ in range(STEPS):
        obs = task.step(act(obs))[0]["obs"]
        rows.append(task.simulation.batch.bind("qpos")[0].copy())
    return np.array(rows)


def played_alone(*words: Any) -> tuple[str, npt.NDArray[np.float64]]:
    """Run play_onnx.py in a process without this package; return its lines and its trace."""
    trace = Path(words[0]).with_name("trace.npz")
    command = [sys.executable, "-I", "-c", ALONE, str(SCRIPT), *map(str, words)]
    command += ["--steps", str(STEPS), "--trace", str(trace)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout, np.load(trace)["qpos"]


def check_same(found: npt.NDArray[np.float64], expected: npt.NDArray[np.float64]) -> None:
    """The robot falls for seven steps, then its legs and later its trunk touch the floor.

    The two differ by the rounding of observations to float32, by 1e-6 (m, rad) in the air; contacts
    multiply that.
    """
    error = np.abs(found - expected).max(axis=1)
    assert error[0] == 0.0
    assert error[:8].max() < 1e-5
    assert error.max() < 1e-3
    assert np.abs(expected[-1] - expected[7]).max() > 0.2


def test_an_exported_network_moves_the_robot_as_in_its_task(make_player, robot, tmp_path) -> None:
    """The whole way, with histories of what a robot measures."""
    player = make_player(observations="deployable", historySteps=3)
    graph = make_exportable_policy(player)
    policy = tmp_path / "policy.onnx"
    metadata = describe(composed(["task=RobotAMP"]), player, graph, {})
    policy.write_bytes(FORMATS["onnx"].write(graph, metadata))
    write_scene(player, policy)
    robot.unlink()
    expected = played_by_the_task(player.env, graph)
    printed, found = played_alone(policy)
    check_same(found, expected)
    height, distance = expected[-1, 2], np.hypot(*(expected[-1, :2] - expected[0, :2]))
    line = f"1.7 s: height {height:.2f} m, {distance:.2f} m from the start"
    assert printed.splitlines()[-1].strip() == line


def test_the_whole_state_is_observed_as_in_the_task(make_player, tmp_path) -> None:
    player = make_player(localRootObs=True)  # without it: the maker's scene below
    act = Linear(player.env.num_obs, player.env.num_actions)
    policy = tmp_path / "policy.onnx"
    policy.write_bytes(act.onnx_file(metadata_of(player)))
    write_scene(player, policy)
    _, found = played_alone(policy)
    check_same(found, played_by_the_task(player.env, act))


def test_the_scene_is_what_was_simulated(make_player, tmp_path) -> None:
    player = make_player(enforceEffortLimits=False)
    scene = write_scene(player, tmp_path / "policy.onnx")
    simulated, written = player.env.simulation.model, mujoco.MjModel.from_xml_path(str(scene))
    assert float(simulated.geom_friction[0, 0]) == 0.7
    assert not simulated.actuator_forcelimited.any()
    for name in (
        *("body_mass", "body_inertia", "body_pos", "body_quat", "jnt_range", "dof_armature"),
        *("geom_friction", "geom_size", "geom_type", "geom_contype", "mesh_vert", "sensor_type"),
        *("actuator_gainprm", "actuator_biasprm", "actuator_biastype", "actuator_forcelimited"),
        *("actuator_gear", "actuator_trnid", "actuator_forcerange"),
    ):
        assert np.array_equal(getattr(written, name), getattr(simulated, name)), name
    assert written.opt.timestep == simulated.opt.timestep
    assert written.opt.disableflags == simulated.opt.disableflags


def test_a_file_that_no_export_wrote_is_kept(make_player, tmp_path) -> None:
    """Such as a robot's own file that is called so."""
    player = make_player()
    policy, own = tmp_path / "g1.onnx", tmp_path / "g1_scene.xml"
    own.write_text("<mujoco/>")
    with pytest.raises(ConfigError, match=r"g1_scene\.xml exists and was not written by an export"):
        scene_of(player.env, policy)
    own.unlink()
    write_scene(player, policy)
    write_scene(player, policy)  # its own it replaces


MAKERS = """
<default><general forcerange="-1 1" ctrlrange="-1 1" gear="7"/></default>
<worldbody><geom type="plane" size="0 0 1" friction=".7"/></worldbody>
<option timestep="0.002"/>
<actuator><motor joint="left"/><motor joint="right"/></actuator>
<sensor><actuatorpos actuator="left"/></sensor>
<keyframe><key qpos="0 0 9 1 0 0 0 1 0 0 0 0 0" ctrl="0 0"/></keyframe>
"""


def test_the_makers_scene_gets_the_drives_of_the_policy(make_player, robot, tmp_path) -> None:
    """Another order of the joints, a free base, other actuators, a smaller time step."""
    player = make_player()
    act = Linear(player.env.num_obs, player.env.num_actions)
    policy = tmp_path / "policy.onnx"
    policy.write_bytes(act.onnx_file(metadata_of(player)))
    text = ROBOT.format(more=MAKERS)
    legs = text.index('<body name="left_leg"'), text.index('<body name="right_leg"')
    end = text.index("</body></worldbody>")
    swapped = text[: legs[0]] + text[legs[1] : end] + text[legs[0] : legs[1]] + text[end:]
    trunk = '<body name="trunk" pos="0 0 .5">'
    robot.write_text(swapped.replace(trunk, f"{trunk}<freejoint/>"))
    _, found = played_alone(policy, robot)
    expected = played_by_the_task(player.env, act)[:, [*range(11), 12, 11]]
    error = np.abs(found - expected).max(axis=1)
    # A step of 8.3 ms in the task, of 2 ms here: both are of first order.
    assert error[:8].max() < 0.02
    assert np.abs(expected[7] - expected[0]).max() > 0.2


def test_commands_reach_the_policy(make_player, tmp_path) -> None:
    """A policy that sees nothing else does what a constant action does.

    The targets are beyond pi, to which the errors of ball joints must not be wrapped.
    """
    player = make_player(actionScale=4.0)
    act = Linear(3, player.env.num_actions)
    metadata = metadata_of(player)
    metadata["observations"] = [
        {"name": "command", "age": 0, "start": 0, "size": 3, "frame": "heading"}
    ]
    policy = tmp_path / "policy.onnx"
    policy.write_bytes(act.onnx_file(metadata))
    write_scene(player, policy)
    command = torch.tensor([[40.0, -20.0, 30.0]])
    _, found = played_alone(policy, "--command", *command[0].tolist())
    expected = played_by_the_task(player.env, lambda obs: act(command).expand(2, -1))
    assert np.abs(found - expected)[:8].max() < 1e-5  # see `check_same`
    assert np.abs(expected[7] - expected[0]).max() > 0.2


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a display is always there")
def test_without_a_display_it_plays_without_a_window(
    make_player, tmp_path, monkeypatch, capsys
) -> None:
    player, policy = make_player(), tmp_path / "policy.onnx"
    act = Linear(player.env.num_obs, player.env.num_actions)
    policy.write_bytes(act.onnx_file(metadata_of(player)))
    write_scene(player, policy)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "argv", ["play_onnx.py", str(policy)])
    capsys.readouterr()
    runpy.run_path(str(SCRIPT), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "no display, so no window: plays 300 control steps"
    assert lines[-1].startswith(" 10.0 s: height ")


# --- files of other people ------------------------------------------------------------------------


def refusal(monkeypatch: pytest.MonkeyPatch, *words: Any) -> str:
    """Run play_onnx.py in this process; return the line with which it ends."""
    monkeypatch.setattr(sys, "argv", ["play_onnx.py", *map(str, words), "--steps", "3"])
    with pytest.raises(SystemExit) as caught:
        runpy.run_path(str(SCRIPT), run_name="__main__")
    line = str(caught.value.code)
    assert line.startswith("play_onnx.py: ")
    assert line.isprintable()
    return line


def changed(metadata: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """A copy of the metadata with another value at `joints.1.name`, ."""
    copied = json.loads(json.dumps(metadata))
    *parents, last = [int(key) if key.isdigit() else key for key in path.split(".")]
    place = copied
    for key in parents:
        place = place[key]
    place[last] = value
    return copied


def test_bad_files_are_one_line(make_player, tmp_path, monkeypatch) -> None:
    player = make_player()
    act, metadata = Linear(player.env.num_obs, player.env.num_actions), metadata_of(player)
    policy = tmp_path / "policy.onnx"
    monkeypatch.chdir(tmp_path)

    def refused(about: dict[str, Any], *words: Any) -> str:
        policy.write_bytes(act.onnx_file(about))
        return refusal(monkeypatch, policy, *words)

    assert "policy_scene.xml" in refused(metadata)  # which is not there
    scene = write_scene(player, policy)
    for path, value, message in (
        ("joints", None, "policy.onnx has no joints: export a policy of RobotAMP or"),
        ("joints.1.name", "knee\x1b[2J", "policy_scene.xml has no joint knee?[2J"),
        ("joints", "__import__('pathlib').Path('pwned').touch()", "JSONDecodeError"),
        ("joints", "[" * 100_000, "RecursionError"),
        ("observations.0.name", "goal", "this script observes no goal of 1 numbers"),
        ("action_scaling.unit", "Nm", "acts by torques"),
        ("control_rate_hz", 1e-9, "simulation steps in a control step of 1e+09 s"),
        ("control_rate_hz", 0, "ZeroDivisionError"),
        ("drives.0", {}, "KeyError: 'stiffness'"),
        ("root.start_qpos", [1e308] * 6, "ValueError: could not broadcast"),
        ("key_bodies", ["tail"], "Invalid name 'tail'"),
    ):
        assert message in refused(changed(metadata, path, value))
    assert "policy.onnx has no observations" in refused({})
    assert not (tmp_path / "pwned").exists()
    scene.write_text("<mujoco><worldbody>")
    assert "XML" in refused(metadata)
    policy.write_bytes(b"no network")
    assert "InvalidProtobuf" in refusal(monkeypatch, policy)


def test_policies_with_other_inputs_are_refused(tmp_path, monkeypatch) -> None:
    """Skills take a latent, too."""
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    tensors = [helper.make_tensor_value_info(name, kind, [1, 2]) for name in ("obs", "latent")]
    output = helper.make_tensor_value_info("action", kind, [1, 2])
    graph = helper.make_graph(
        [helper.make_node("Add", ["obs", "latent"], ["action"])], "skills", tensors, [output]
    )
    opset = helper.make_opsetid("", 18)
    policy = tmp_path / "skills.onnx"
    onnx.save(helper.make_model(graph, ir_version=10, opset_imports=[opset]), policy)
    assert "takes obs, latent: this script plays policies of obs alone" in refusal(
        monkeypatch, policy
    )
