from __future__ import annotations

import mujoco
import numpy as np
import torch

from isaacgymenvs_lite.rendering.tracks import PoseRecorder


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
