"""HumanoidViewMotion: the state is that of the clip, step by step and clip by clip.

See `walk_clip` in tests/conftest.py: 1.5 s, root at x = t and height 0.88 + 0.05 t.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.npz import load_npz, save_npz
from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.tasks.ase.humanoid_view_motion import HumanoidViewMotion

# The library's interpolated rotations are of unit length to 2e-5 only (acos of a number near 1 in
# float32), which MuJoCo mends.
ATOL = 4e-5
STEP_S = 1.0 / 30.0
# Frames at 25 Hz of the clips of the data set, and control steps until their ends: 0.16 s, 0.28 s
# and 1.76 s are 4.8, 8.4 and 52.8 steps.
FRAMES, STEPS = (5, 8, 45), (5, 9, 53)


@pytest.fixture
def make(make_ase):
    """Return a maker of HumanoidViewMotion."""
    return lambda *args, **env: make_ase(*args, cls=HumanoidViewMotion, **env)


@pytest.fixture
def three_clips(walk_clip: Path, tmp_path: Path) -> Path:
    """Return a data set of beginnings of the walking clip, at 25 Hz."""
    lines, clip = ["motions:"], load_npz(walk_clip)
    for frames in FRAMES:
        beginning = MotionClip.from_poses(
            f"frames_{frames}",
            25.0,
            clip.body_names,
            clip.parent_indices,
            clip.local_translation,
            clip.local_rotation[:frames],
            clip.root_translation[:frames],
        )
        save_npz(tmp_path / f"{frames}.npz", beginning)
        lines += [f"  - file: {frames}.npz", "    weight: 1.0"]
    path = tmp_path / "three.yaml"
    path.write_text("\n".join(lines) + "\n")
    return path


def _shows(task: HumanoidViewMotion, motion_ids: list[int], times_s: list[float]) -> None:
    """Check that the characters are in the states of the clips, at rest."""
    sim, keys = task.simulation, [5, 8, 11, 14]
    library = MotionLib(task.env_cfg.motion_file, 28, keys, "cpu", interpolation="spline")
    state = library.get_motion_state(motion_ids, torch.tensor(times_s, dtype=torch.float64))
    root = torch.cat((state.root_pos, state.root_rot, torch.zeros(len(times_s), 6)), dim=-1)
    torch.testing.assert_close(sim.root_states, root, rtol=0.0, atol=ATOL)
    torch.testing.assert_close(sim.dof_pos, state.dof_pos, rtol=0.0, atol=ATOL)
    assert (sim.dof_vel == 0.0).all()
    # Bodies are those of the new state; between frames the library goes along chords.
    torch.testing.assert_close(sim.body_pos[:, keys], state.key_pos, rtol=0.0, atol=1e-3)


def test_the_state_is_that_of_the_clip_whatever_the_actions(make) -> None:
    torch.manual_seed(0)
    task = make(2)
    task.reset_done()
    _shows(task, [0, 0], [0.0, 0.0])
    for step in range(1, 8):
        observations, *_ = task.step(torch.randn(2, 28))
        _shows(task, [0, 0], [step * STEP_S] * 2)
        height = 0.88 + 0.05 * step * STEP_S
        assert observations["obs"][:, 0].tolist() == pytest.approx([height] * 2, abs=1e-5)


def test_a_clip_is_followed_by_the_one_after_those_of_the_others(make, three_clips: Path) -> None:
    # Two environments: 0, 2, 1, 0 and 1, 0, 2.
    task = make(2, motion_file=str(three_clips))
    task.reset_done()
    ends = [[], []]
    for step in range(1, 75):
        *_, dones, infos = task.step(task.zero_actions())
        assert infos["terminate"].tolist() == [0, 0]
        for env, done in enumerate(dones.tolist()):
            if done:
                ends[env].append(step)
        _, done_ids = task.reset_done()
        assert done_ids.tolist() == [env for env in (0, 1) if ends[env][-1:] == [step]]
        assert (task.progress_buf[done_ids] == 0).all()
    short, middle, long = STEPS
    assert ends[0] == [short, short + long, short + long + middle, 2 * short + long + middle]
    assert ends[1] == [middle, middle + short, middle + short + long]


def test_nothing_but_the_end_of_the_clip_ends_an_episode(make) -> None:
    # Neither a height that counts as a fall anywhere nor the time limit.
    heights = {"terminationHeight": 5.0, "contactBodies": []}
    task = make(2, episodeLength=4, **heights)
    task.reset_done()
    for _ in range(12):
        *_, dones, infos = task.step(task.zero_actions())
        assert dones.tolist() == infos["terminate"].tolist() == [0, 0]
        assert infos["time_outs"].tolist() == [False, False]


def test_playback_has_the_task_s_time_and_the_simulator_half_of_it(make) -> None:
    # Recorders take the rate of their frames from `dt`.
    task = make(1)
    assert task.dt == pytest.approx(STEP_S)
    assert task.simulation.substeps == 2
    slow = make(1, controlFrequencyInv=4, sim={"dt": 0.01})
    slow.reset_done()
    slow.step(slow.zero_actions())
    assert slow.dt == pytest.approx(0.04)
    _shows(slow, [0], [0.04])
