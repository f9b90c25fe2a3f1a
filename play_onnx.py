"""Plays an exported policy on its robot. Needs mujoco, onnxruntime and numpy, nothing else.

    python play_onnx.py policy.onnx                      # a window; the scene is policy_scene.xml
    python play_onnx.py policy.onnx /robots/scene.xml    # another scene with the same robot
    python play_onnx.py policy.onnx --steps 300          # no window: heights and distances
    python play_onnx.py policy.onnx --command 0.5 0 0    # m/s forward, m/s left, rad/s left

It is written to be read and copied: a program on the robot computes the same. The metadata of the
ONNX file is described in docs/taking_it_with_you.md.
"""

import argparse
import itertools
import json
import os
import sys
import time
from collections import deque

import mujoco
import mujoco.viewer
import numpy as np
import onnxruntime

KEYS = ("observations", "action_scaling", "control_rate_hz", "drives", "joints", "root")


def read_policy(file):
    """Return the network and its metadata, from a file that may be anybody's."""
    policy = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    if (inputs := [tensor.name for tensor in policy.get_inputs()]) != ["obs"]:
        stop(f"{file} takes {', '.join(inputs)}: this script plays policies of obs alone")
    stored = policy.get_modelmeta().custom_metadata_map
    about = {key: json.loads(stored.get(key, "null")) for key in (*KEYS, "key_bodies")}
    if missing := [key for key in KEYS if about[key] is None]:
        stop(f"{file} has no {missing[0]}: export a policy of RobotAMP or HumanoidAMP anew")
    if about["action_scaling"]["unit"] != "rad":
        stop(f"{file} acts by torques: this script has position drives")
    return policy, about


class Robot:
    """A robot in a scene, with the drives, the control rate and a start of its training."""

    def __init__(self, scene, about, stands):
        spec = mujoco.MjSpec.from_file(scene)
        for thing in [*spec.keys, *spec.sensors, *spec.actuators]:
            spec.delete(thing)
        names = [joint["name"] for joint in about["joints"]]
        if missing := set(names) - {joint.name for joint in spec.joints}:
            stop(f"{scene} has no joint {', '.join(sorted(missing))}")
        for drive in about["drives"]:
            add_drive(spec, drive)
        control_dt = 1.0 / about["control_rate_hz"]
        self.substeps = max(1, round(control_dt / spec.option.timestep))
        if not 1e-4 <= control_dt <= 1.0 or self.substeps > 1000:
            stop(f"{self.substeps} simulation steps in a control step of {control_dt:g} s")
        spec.option.timestep = control_dt / self.substeps
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # for stiff drives
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.base = self.data.body(about["root"]["body"])
        self.root = self.data.joint(int(self.model.body(self.base.id).jntadr[0]))  # a free joint
        self.joints = [self.data.joint(name) for name in names]
        for joint, described in zip(
            [self.root, *self.joints], [about["root"], *about["joints"]], strict=True
        ):
            joint.qpos[:] = described["default_qpos" if stands else "start_qpos"]
            joint.qvel[:] = 0.0 if stands else described["start_qvel"]
        defaults = [np.array(joint["default_qpos"], float) for joint in about["joints"]]
        self.default_angles = np.hstack([angles_and_features(qpos)[0] for qpos in defaults])
        self.key_bodies = [self.data.body(name) for name in about["key_bodies"]]
        self.frames = {part["name"]: part["frame"] for part in about["observations"]}

    def observe(self, last_action, command):
        """Return the parts of observations by name; _w: in the world frame, _b: in the base's."""
        mujoco.mj_kinematics(self.model, self.data)
        lin_vel_w, ang_vel_b = self.root.qvel[:3], self.root.qvel[3:]
        to_world = self.base.xmat.reshape(3, 3)  # from the base frame
        x, y = to_world[:2, 0] / max(np.hypot(*to_world[:2, 0]), 1e-9)  # where the base faces
        to_heading = np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]])  # from the world frame
        is_local = self.frames.get("root_rot_tan_norm") == "heading"
        rotation = to_heading @ to_world if is_local else to_world
        positions = [angles_and_features(joint.qpos) for joint in self.joints]
        parts = {
            "root_height": self.base.xpos[2:],
            "root_rot_tan_norm": rotation.T[[0, 2]],  # the base's x axis and z axis
            "root_lin_vel": to_heading @ lin_vel_w,
            "root_ang_vel": to_heading @ to_world @ ang_vel_b,
            "dof_pos": [features for _, features in positions],
            "dof_vel": [joint.qvel for joint in self.joints],
            "key_body_pos": [to_heading @ (b.xpos - self.base.xpos) for b in self.key_bodies],
            "root_ang_vel_b": ang_vel_b,
            "gravity_b": -to_world[2],
            "dof_pos_offset": np.hstack([angles for angles, _ in positions]) - self.default_angles,
            "last_action": last_action,
            "command": command,
        }
        return {name: np.hstack([[], *values]) for name, values in parts.items()}


def add_drive(spec, drive):
    """Add a position drive to a joint, or to one axis of a ball joint."""
    kp, kd, limit = drive["stiffness"], drive["damping"], drive["effort_limit"]
    spec.joint(drive["joint"]).armature = drive["armature"]
    actuator = spec.add_actuator(name=drive["name"], target=drive["joint"])
    actuator.trntype, actuator.gear = mujoco.mjtTrn.mjTRN_JOINT, [*drive["gear"], 0, 0, 0]
    actuator.set_to_position(kp=kp, kv=kd)
    actuator.biasprm[1] = np.nextafter(-kp, 0)  # -kp would wrap errors of ball joints into +-pi
    actuator.ctrllimited, actuator.forcelimited = False, limit is not None
    actuator.forcerange = [-(limit or 0), limit or 0]


def angles_and_features(qpos):
    """Return a joint's angle or rotation vector (rad), and what AMP's policies observe of it."""
    if len(qpos) == 1:  # a hinge
        return qpos, qpos
    vector, matrix = np.zeros(3), np.zeros(9)
    mujoco.mju_quat2Vel(vector, qpos, 1.0)
    mujoco.mju_quat2Mat(matrix, qpos)
    return vector, matrix.reshape(3, 3).T[[0, 2]].ravel()  # the turned x axis and z axis


def stop(reason):
    """End with one line, without what a terminal could take for a command."""
    text = " ".join(str(reason).split())
    raise SystemExit("play_onnx.py: " + "".join(c if c.isprintable() else "?" for c in text))


def main():
    """Run the command line."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("policy", help="an ONNX file of isaacgymenvs_lite.export")
    parser.add_argument("scene", nargs="?", help="MJCF; default: what the export wrote beside it")
    parser.add_argument("--steps", type=int, help="play so many control steps, without a window")
    parser.add_argument("--stand", action="store_true", help="start in the default pose, at rest")
    parser.add_argument("--command", type=float, nargs=3, default=(0, 0, 0), metavar="V")
    parser.add_argument("--trace", help=".npz file for qpos, before the first and after each step")
    args = parser.parse_args()
    shows = sys.platform != "linux" or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    if not args.steps and not shows:
        args.steps = 300
        print(f"no display, so no window: plays {args.steps} control steps")

    policy, about = read_policy(args.policy)
    scene = args.scene or args.policy.removesuffix(".onnx") + "_scene.xml"
    robot = Robot(scene, about, args.stand)
    parts, rate = about["observations"], about["control_rate_hz"]
    offset, scale = (np.float32(about["action_scaling"][key]) for key in ("offset", "scale"))
    action = np.zeros(len(about["drives"]))
    frame = robot.observe(action, args.command)
    for part in parts:
        if len(frame.get(part["name"], ())) != part["size"]:
            stop(f"this script observes no {part['name']} of {part['size']} numbers")
    history = deque([frame], maxlen=1 + max(part["age"] for part in parts))  # newest first
    start, trace = robot.root.qpos[:2].copy(), [robot.data.qpos.copy()]
    window = None if args.steps else mujoco.viewer.launch_passive(robot.model, robot.data)
    if window:  # the camera follows the robot
        window.cam.type, window.cam.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, robot.base.id
    begin = time.perf_counter()
    for step in range(1, args.steps + 1) if args.steps else itertools.count(1):
        # At the start the first frame takes the place of those before it.
        frames = [history[min(part["age"], len(history) - 1)] for part in parts]
        values = [frame[part["name"]] for frame, part in zip(frames, parts, strict=True)]
        obs = np.hstack(values, dtype=np.float32)[None]
        action = np.asarray(policy.run(["action"], {"obs": obs})[0])[0]
        robot.data.ctrl[:] = offset + scale * action  # the drives' targets, rad
        mujoco.mj_step(robot.model, robot.data, robot.substeps)
        history.appendleft(robot.observe(action, args.command))
        trace.append(robot.data.qpos.copy())
        if step % round(rate) == 0 or step == args.steps:
            height, distance = robot.root.qpos[2], np.hypot(*(robot.root.qpos[:2] - start))
            print(f"{step / rate:5.1f} s: height {height:.2f} m, {distance:.2f} m from the start")
        if window:
            window.sync()
            time.sleep(max(0.0, begin + step / rate - time.perf_counter()))
            if not window.is_running():
                break
    if args.trace:
        np.savez(args.trace, qpos=trace)


if __name__ == "__main__":
    try:
        main()
    except Exception as error:
        stop(f"{type(error).__name__}: {error}")
