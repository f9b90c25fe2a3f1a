from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering import display
from isaacgymenvs_lite.rendering.display import check_display
from isaacgymenvs_lite.rendering.tracks import PoseRecorder
from isaacgymenvs_lite.viewers.reference_overlay import reference_track


def body_pos(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Where MuJoCo puts the bodies, (B, 3) m."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return data.xpos[1:].copy()


def test_a_track_is_what_the_simulation_did(make_env):
    env = make_env()
    recorder = PoseRecorder(env, num_steps=100, env_ids=(2, 0))
    seen = []
    generator = torch.Generator().manual_seed(1)
    for _ in range(12):
        env.step(2.0 * torch.rand(3, 28, generator=generator) - 1.0)
        recorder.step()
        seen.append(env.simulation.body_pos[[2, 0]].clone())
    tracks = recorder.tracks()
    assert [track.shape for track in tracks] == [(12, 43)] * 2  # root 7, eight balls, four hinges
    for t in range(12):
        for track, expected in zip(tracks, seen[t], strict=True):
            # float32 on the way
            np.testing.assert_allclose(
                body_pos(env.simulation.model, track[t]), expected, atol=2e-5
            )


def test_no_more_steps_are_kept_than_asked_for(make_env):
    env = make_env()
    recorder = PoseRecorder(env, num_steps=3)
    assert recorder.tracks() == []
    for _ in range(5):
        env.step(env.zero_actions())
        recorder.step()
    (track,) = recorder.tracks()
    assert len(track) == 3


def track_along_the_clip(env: Any, start_s: torch.Tensor, num_steps: int) -> list[np.ndarray]:
    """Tracks of humanoids that are put into the clip pose by pose, without physics."""
    rows = torch.arange(env.num_envs)
    recorder = PoseRecorder(env, num_steps, rows.tolist())
    for step in range(num_steps):
        state = env.motion_lib.get_motion_state(0 * rows, start_s + step * env.dt)
        roots = torch.cat(state[:2] + state[3:5], dim=-1)
        env.simulation.write_state(rows, roots, state.dof_pos, state.dof_vel)
        recorder.step()
    return recorder.tracks()


def test_the_reference_begins_in_the_same_phase(make_env):
    env = make_env()
    start_s = torch.tensor([0.2, 0.55, 0.9])
    tracks = track_along_the_clip(env, start_s, 10)
    for track, begin_s in zip(tracks, start_s.tolist(), strict=True):
        reference = reference_track(env, track)
        assert reference.shape == track.shape
        # The clip's root is at x = t m: the nearest control step is half of one away at most.
        assert reference[0, 0] == pytest.approx(begin_s, abs=0.51 * env.dt)


def test_a_reference_that_ends_goes_on_from_where_it_is(make_env):
    env = make_env()
    track = track_along_the_clip(env, torch.zeros(3), 6)[0]
    like = np.concatenate((track, np.repeat(track[-1:], 94, axis=0)))  # 3.3 s, the clip has 1.5 s
    reference = reference_track(env, like)
    np.testing.assert_allclose(reference[:6], track, atol=1e-5)
    times_s = np.arange(100) * env.dt
    # x goes on at 1 m/s; the height, 0.88 + 0.05 t, begins again
    np.testing.assert_allclose(reference[:, 0], times_s, atol=1e-4)
    np.testing.assert_allclose(reference[:, 2], 0.88 + 0.05 * (times_s % 1.5), atol=1e-4)


@pytest.mark.parametrize("reason", ["no display", "no library"])
def test_without_a_display_there_is_one_line(reason, monkeypatch):
    class Glfw:
        @staticmethod
        def init() -> bool:
            return False

    def import_module(name: str) -> type:
        if reason == "no library":
            raise ImportError("libglfw.so.3")
        return Glfw

    monkeypatch.setattr(display.importlib, "import_module", import_module)
    with pytest.raises(ConfigError, match=r"headless=False: .*viewer=web") as caught:
        check_display()
    assert "\n" not in str(caught.value)
