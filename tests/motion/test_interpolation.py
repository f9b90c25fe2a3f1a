"""Tests the splines between the frames of clips; velocities are derivatives of the poses."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.formats.npz import save_npz
from isaacgymenvs_lite.motion.motion_lib import MotionLib, MotionState
from isaacgymenvs_lite.motion.qpos import clip_from_qpos
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.utils import rotations

FPS = 30.0
# The derivative of a cubic spline is off by h^3 f'''' / 24 and, at the ends, by some times that:
# frames 1/30 s apart, rates of at most 4 rad/s and amplitudes near 1.
SPLINE_ATOL = 2e-3
# float32 numbers near 1, differentiated over 2 ms.
DIFFERENCE_ATOL = 2e-3


def library(path: Path, skeleton: Skeleton, qpos: np.ndarray, **settings) -> MotionLib:
    clip = clip_from_qpos("clip", FPS, skeleton, qpos)
    keys = range(skeleton.num_bodies)
    file = save_npz(path / "clip.npz", clip)
    settings = {"interpolation": "spline", "skeleton": skeleton, **settings}
    return MotionLib(file, skeleton.num_dofs, list(keys), "cpu", **settings)


def states(lib: MotionLib, times_s: np.ndarray) -> MotionState:
    return lib.get_motion_state(torch.zeros(len(times_s), dtype=torch.long), times_s)


def turning(skeleton: Skeleton, times_s: np.ndarray) -> np.ndarray:
    """Fall with x = t, z = 1 - 4.9 t^2, spin at 3 rad/s about z, and swing the first joints."""
    qpos = np.zeros((len(times_s), skeleton.qpos_addresses[-1]))
    qpos[:, 0], qpos[:, 2] = times_s, 1.0 - 4.9 * times_s**2
    qpos[:, 3], qpos[:, 6] = np.cos(1.5 * times_s), np.sin(1.5 * times_s)
    for address, size in zip(skeleton.qpos_addresses, skeleton.dof_sizes, strict=False):
        if size == 1:
            qpos[:, address] = np.sin(4.0 * times_s)
        else:  # 0.8 sin(2 t) rad about x
            half = 0.4 * np.sin(2.0 * times_s)
            qpos[:, address], qpos[:, address + 1] = np.cos(half), np.sin(half)
    return qpos


def test_velocities_of_a_known_motion(tmp_path, humanoid):
    lib = library(tmp_path, humanoid, turning(humanoid, np.arange(31) / FPS))
    times_s = np.linspace(0.0, 1.0, 97)  # between frames, too
    found = states(lib, times_s)
    ones, zeros = np.ones_like(times_s), np.zeros_like(times_s)
    root_vel = np.stack((ones, zeros, -9.8 * times_s), axis=-1)
    np.testing.assert_allclose(found.root_vel, root_vel, atol=1e-4)  # a parabola: exact
    spin = np.stack((zeros, zeros, 3.0 * ones), axis=-1)
    np.testing.assert_allclose(found.root_ang_vel, spin, atol=SPLINE_ATOL)
    for start, size in zip(humanoid.dof_offsets, humanoid.dof_sizes, strict=False):
        expected = 4.0 * np.cos(4.0 * times_s) if size == 1 else 1.6 * np.cos(2.0 * times_s)
        pose = np.sin(4.0 * times_s) if size == 1 else 0.8 * np.sin(2.0 * times_s)
        np.testing.assert_allclose(found.dof_vel[:, start], expected, atol=SPLINE_ATOL)
        np.testing.assert_allclose(found.dof_pos[:, start], pose, atol=1e-4)


def test_velocities_as_published_lag_behind(tmp_path, humanoid):
    """The published interpolation gives differences to the next frame and a smoothed fall."""
    qpos = turning(humanoid, np.arange(31) / FPS)
    lib = library(tmp_path, humanoid, qpos, interpolation="published")
    found = states(lib, np.array([0.5]))
    knee = humanoid.dof_offsets[humanoid.dof_sizes.index(1)]
    difference = FPS * (math.sin(4.0 * (0.5 + 1 / FPS)) - math.sin(4.0 * 0.5))
    assert found.dof_vel[0, knee].item() == pytest.approx(difference, abs=1e-3)
    at_the_end = states(lib, np.array([1.0]))
    assert at_the_end.root_vel[0, 2].item() > -9.5  # the filter repeats the end values


@pytest.mark.parametrize("name", ["humanoid", "robot"])
def test_velocities_are_derivatives_and_bodies_are_where_the_joints_put_them(
    tmp_path, request, moving, name
):
    skeleton: Skeleton = request.getfixturevalue(name)
    qpos = moving(skeleton)
    lib = library(tmp_path, skeleton, qpos[:, : skeleton.qpos_addresses[-1]])
    times_s = np.linspace(0.05, (len(qpos) - 1) / FPS - 0.05, 40)
    now = states(lib, times_s)
    before, after = (states(lib, times_s + shift) for shift in (-1e-3, 1e-3))
    rate = (after.root_pos - before.root_pos) / 2e-3
    torch.testing.assert_close(rate, now.root_vel, atol=DIFFERENCE_ATOL, rtol=1e-3)
    turn = rotations.quat_mul(after.root_rot, rotations.quat_conjugate(before.root_rot))
    turn_rate = rotations.quat_log(turn) / 2e-3
    torch.testing.assert_close(turn_rate, now.root_ang_vel, atol=DIFFERENCE_ATOL, rtol=1e-3)
    hinges = [d for d, s in zip(skeleton.dof_offsets, skeleton.dof_sizes, strict=False) if s == 1]
    rates = (after.dof_pos - before.dof_pos)[:, hinges] / 2e-3
    torch.testing.assert_close(rates, now.dof_vel[:, hinges], atol=5e-3, rtol=1e-3)

    model = skeleton.model
    data = mujoco.MjData(model)
    root = int(model.jnt_bodyid[0])
    for i in range(0, len(times_s), 8):
        data.qpos[:3] = now.root_pos[i].numpy()
        data.qpos[3:7] = rotations.wxyz_from_xyzw(now.root_rot[i]).numpy()
        for group, (start, size) in enumerate(
            zip(skeleton.dof_offsets, skeleton.dof_sizes, strict=False)
        ):
            address, value = skeleton.qpos_addresses[group], now.dof_pos[i, start : start + size]
            if size == 3:
                turned = rotations.exp_map_to_quat(value.unsqueeze(0))[0]
                value = rotations.wxyz_from_xyzw(turned)
            data.qpos[address : address + value.numel()] = value.numpy()
        mujoco.mj_kinematics(model, data)
        expected = data.xpos[root : root + skeleton.num_bodies]
        np.testing.assert_allclose(now.key_pos[i], expected, atol=1e-5)
    bodies = lib.get_body_pos(torch.zeros(len(times_s), dtype=torch.long), times_s)
    torch.testing.assert_close(bodies, now.key_pos, atol=0.0, rtol=0.0)


def test_frames_are_kept(tmp_path, humanoid, moving):
    qpos = moving(humanoid)
    times_s = np.arange(len(qpos)) / FPS
    kept = states(library(tmp_path, humanoid, qpos), times_s)
    published = states(library(tmp_path, humanoid, qpos, interpolation="published"), times_s)
    torch.testing.assert_close(kept.root_pos, published.root_pos, atol=1e-5, rtol=0.0)
    # The published slerp rounds rotations that are nearly equal to their mean.
    same = (kept.root_rot * published.root_rot).sum(dim=-1).abs()
    torch.testing.assert_close(same, torch.ones_like(same), atol=1e-4, rtol=0.0)
    torch.testing.assert_close(kept.key_pos, published.key_pos, atol=1e-4, rtol=0.0)


def test_before_the_start_it_goes_on_backwards_and_after_the_end_it_stays(tmp_path, humanoid):
    lib = library(tmp_path, humanoid, turning(humanoid, np.arange(31) / FPS))
    start, early = states(lib, np.array([0.0])), states(lib, np.array([-0.1]))
    torch.testing.assert_close(early.root_pos, start.root_pos - 0.1 * start.root_vel)
    torch.testing.assert_close(early.root_vel, start.root_vel)
    end, late = states(lib, np.array([1.0])), states(lib, np.array([1.0 + 0.5 / FPS]))
    for a, b in zip(end, late, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=0.0)


def test_the_sign_of_a_quaternion_does_not_matter(tmp_path, humanoid, moving):
    clip = clip_from_qpos("clip", FPS, humanoid, moving(humanoid))
    signs = np.where(np.arange(clip.num_frames) % 3 == 0, -1.0, 1.0)[:, None, None]
    flipped = dataclasses.replace(clip, local_rotation=clip.local_rotation * signs)
    times_s = np.linspace(0.0, 1.2, 50)
    found = []
    for i, each in enumerate((clip, flipped)):
        file = save_npz(tmp_path / f"{i}.npz", each)
        found.append(states(MotionLib(file, 28, [5], "cpu", interpolation="spline"), times_s))
    for name in ("root_ang_vel", "dof_vel", "key_pos"):
        first, second = (getattr(state, name) for state in found)
        torch.testing.assert_close(first, second, atol=1e-4, rtol=1e-5)


def test_user_mistakes(tmp_path, tiny, tiny_clip):
    file = save_npz(tmp_path / "tiny.npz", tiny_clip)
    with pytest.raises(ConfigError, match=r"unknown interpolation 'splines' .*'spline'"):
        MotionLib(file, 4, [2], "cpu", skeleton=tiny, interpolation="splines")
