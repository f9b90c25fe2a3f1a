"""The pose error: what must give zero, what must not, and by how much."""

import math

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.evaluation import pose_error as imitation
from isaacgymenvs_lite.evaluation.body_tracks import tracks_of_clips
from isaacgymenvs_lite.evaluation.pose_error import (
    Episode,
    EpisodeRecorder,
    PoseErrorMetric,
    ReferencePoses,
    align,
    root_relative_pose,
)
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.npz import save_npz
from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.motion.skeleton import skeleton_for_num_dofs
from isaacgymenvs_lite.utils.rotations import quat_from_angle_axis, quat_rotate

NUM_BODIES = 15
NUM_FRAMES = 40
HAND = 5
# Poses of about 1 m in float32, turned and moved by some metres: a few 1e-7 m per coordinate.
ROUNDING_M = 2e-6


def gait(frames, size=1.0):
    """Poses (n, J, 3) of a made-up periodic motion of `NUM_FRAMES` frames, without symmetry."""
    rng = np.random.default_rng(7)
    rest, swing, phase = (
        rng.normal(size=(3, NUM_BODIES, 3)) * np.array([0.4, 0.2, 3.0])[:, None, None]
    )
    angle = 2.0 * math.pi * np.asarray(frames)[:, None, None] / NUM_FRAMES
    poses = rest + size * swing * np.sin(angle + phase)
    return torch.from_numpy(poses - poses[:, :1]).float()


def frame_way_m():
    """How far a body moves in one frame of the motion, on average."""
    return float((gait(range(1, 41)) - gait(range(40))).norm(dim=-1).mean())


@pytest.fixture
def metric():
    return PoseErrorMetric(ReferencePoses([gait(range(NUM_FRAMES))]))


def error_m(metric, *poses):
    return metric.evaluate([Episode(p, fell=False) for p in poses]).pose_error_m


def about(axis, angle_rad):
    axis = torch.tensor(axis, dtype=torch.float32)
    return quat_from_angle_axis(torch.tensor(float(angle_rad)), axis)


def in_world(poses, rotation, root_pos=(3.0, -2.0, 0.9)):
    """Return (body_pos_w, root_rot_w) of the poses turned by one rotation and moved."""
    turned = quat_rotate(rotation.expand(*poses.shape[:-1], 4), poses)
    return turned + torch.tensor(root_pos), rotation.expand(len(poses), 4)


def test_root_relative_pose_computed_by_hand():
    # Heading +y: what lies 2 m to the north of the root lies 2 m ahead of it, west is left.
    body_pos_w = torch.tensor([[5.0, 5.0, 1.0], [5.0, 7.0, 1.5], [4.0, 5.0, 1.0]])
    pose = root_relative_pose(body_pos_w, about((0.0, 0.0, 1.0), math.pi / 2))
    expected = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.5], [0.0, 1.0, 0.0]]
    np.testing.assert_allclose(pose, expected, atol=1e-6)  # sine and cosine in float32


@pytest.mark.parametrize(("offset", "heading_rad"), [(0, 0.0), (17, 2.5)])
def test_reference_itself_gives_zero(metric, offset, heading_rad):
    frames = gait(offset + np.arange(3 * NUM_FRAMES))
    poses = root_relative_pose(*in_world(frames, about((0.0, 0.0, 1.0), heading_rad)))
    result = metric.evaluate([Episode(poses, fell=False)])
    assert result.pose_error_m < ROUNDING_M
    assert result.tempo == 1.0
    assert result.no_fall_share == 1.0


def test_slow_replay_gives_zero_and_half_the_tempo(metric):
    result = metric.evaluate([Episode(gait(0.5 * np.arange(101)), fell=False)])
    # Every other pose is a frame of the clip, the ones between are half a frame's way from two.
    assert result.pose_error_m == pytest.approx(frame_way_m() / 4, rel=0.05)
    assert result.tempo == pytest.approx(0.5, abs=0.02)
    stuttering = metric.reference.clips[0].repeat_interleave(2, dim=0)
    assert error_m(metric, stuttering) == 0.0


def test_fast_replay_fits_the_reference(metric):
    # Skipped frames are cells too: half a frame's way each, as the poses between frames.
    result = metric.evaluate([Episode(gait(30 + 1.5 * np.arange(100)), fell=False)])
    assert result.pose_error_m < frame_way_m() / 2
    assert result.tempo == pytest.approx(1.5, abs=0.02)


def test_frozen_pose_has_tempo_zero(metric):
    result = metric.evaluate([Episode(gait([13] * 100), fell=False)])
    assert result.pose_error_m < ROUNDING_M
    assert result.tempo == 0.0


def test_small_steps_of_a_small_motion_keep_their_tempo():
    # As a turn on the spot: bodies move by 0.05 m about their mean, in the episode by 0.3 of it.
    # The poses of so small steps are nearest to the same frames of the clip nearly all the time.
    metric = PoseErrorMetric(ReferencePoses([gait(range(NUM_FRAMES), size=0.2)]))
    for tempo in (0.5, 0.8):
        small = metric.evaluate([Episode(gait(tempo * np.arange(200), size=0.06), fell=False)])
        assert small.tempo == pytest.approx(tempo, abs=0.03)
    standing = metric.evaluate([Episode(gait(np.arange(200), size=0.0), fell=False)])
    assert standing.tempo < 0.05


def test_offset_of_one_hand_is_shared_by_all_bodies():
    # In a clip of one pose there is nothing to warp to: the error is d / 15.
    pose = gait([0])
    moved = pose.repeat(20, 1, 1)
    moved[:, HAND, 1] += 0.3
    result = error_m(PoseErrorMetric(ReferencePoses([pose])), moved)
    assert result == pytest.approx(0.3 / NUM_BODIES, abs=1e-7)


def test_pitched_character_is_wrong(metric):
    # Turned by 0.2 rad about y, a body at distance r from the axis moves by 2 sin(0.1) r.
    poses = gait(np.arange(100))
    leaning = root_relative_pose(*in_world(poses, about((0.0, 1.0, 0.0), 0.2)))
    way = 2.0 * math.sin(0.1) * poses[..., [0, 2]].norm(dim=-1).mean()
    assert error_m(metric, leaning) == pytest.approx(float(way), rel=0.1)  # less by warping


def test_episode_counts_with_its_nearest_clip():
    still, moved = gait([0]), gait([0]) + 0.0
    moved[:, HAND, 2] += 1.5
    metric = PoseErrorMetric(ReferencePoses([still, moved]))
    near_second = moved.repeat(5, 1, 1)
    near_second[:, HAND, 2] += 0.15
    result = metric.evaluate([Episode(near_second, False), Episode(still.repeat(3, 1, 1), False)])
    assert result.nearest_clip.tolist() == [1, 0]
    np.testing.assert_allclose(result.per_episode, [0.15 / NUM_BODIES, 0.0], atol=1e-7)
    assert result.pose_error_m == pytest.approx(0.075 / NUM_BODIES, abs=1e-7)


def test_batch_equals_one_by_one_in_chunks_too(metric, monkeypatch):
    generator = torch.Generator().manual_seed(0)
    episodes = [
        Episode(torch.randn(n, NUM_BODIES, 3, generator=generator), fell=n < 20)
        for n in (90, 1, 37, 90, 12, 60)
    ]
    expected = [metric.evaluate([episode]).pose_error_m for episode in episodes]
    # The batch pads with zeros and orders by length: not a bit may depend on that.
    together = metric.evaluate(episodes)
    np.testing.assert_array_equal(together.per_episode, expected)
    assert together.no_fall_share == pytest.approx(4 / 6)
    assert together.mean_episode_steps == pytest.approx(290 / 6)
    assert together.num_episodes == 6
    monkeypatch.setattr(imitation, "_CHUNK_BYTES", 2 * 8 * NUM_FRAMES * 90)
    np.testing.assert_array_equal(metric.evaluate(episodes).per_episode, expected)


def test_episode_that_diverged_is_a_fall_and_not_in_the_mean(metric):
    broken = gait(np.arange(10))
    broken[4, 3, 0] = math.nan
    result = metric.evaluate([Episode(broken, False), Episode(gait(np.arange(10)), False)])
    assert result.pose_error_m < ROUNDING_M
    assert np.isnan(result.per_episode[0])
    assert result.nearest_clip.tolist() == [-1, 0]
    assert result.no_fall_share == 0.5
    alone = metric.evaluate([Episode(broken, False)])
    assert math.isnan(alone.pose_error_m)
    assert math.isnan(alone.tempo)


def test_result_reads_as_one_line(metric):
    text = str(metric.evaluate([Episode(gait([0]), False), Episode(gait([0, 1, 2]), True)]))
    assert text == ("pose error 0.000 m at tempo 0.50, 50% without a fall")


def test_refuses_what_it_cannot_measure(metric):
    with pytest.raises(ValueError, match="no episode to measure"):
        metric.evaluate([])
    with pytest.raises(ValueError, match=r"\(4, 13, 3\).*J = 15"):
        metric.evaluate([Episode(torch.zeros(4, 13, 3), False)])


def test_reference_from_a_motion_library(tmp_path):
    # A statue, arms forward, carried on a circle: in the heading frame it does not move.
    skeleton = skeleton_for_num_dofs(28)
    num_frames, fps = 31, 30.0
    turn = torch.linspace(0.0, 2.0 * math.pi, num_frames)
    rotation = torch.zeros(num_frames, skeleton.num_bodies, 4)
    rotation[..., 3] = 1.0
    rotation[:, 0] = quat_from_angle_axis(turn, torch.tensor([0.0, 0.0, 1.0]))
    shoulder = skeleton.body_names.index("left_upper_arm")
    rotation[:, shoulder] = about((0.0, 1.0, 0.0), -math.pi / 2)
    place = torch.stack((turn.cos(), turn.sin(), torch.ones(num_frames)), dim=-1)
    clip = MotionClip.from_poses(
        "statue",
        fps,
        skeleton.body_names,
        skeleton.parent_indices,
        skeleton.local_translation,
        rotation.numpy(),
        place.numpy(),
    )
    path = save_npz(tmp_path / "statue.npz", clip)
    lib = MotionLib(path, 28, [5, 8, 11, 14], "cpu")
    poses = ReferencePoses.from_tracks(tracks_of_clips(lib, 1.0 / 30.0)).clips[0]
    assert poses.shape == (30, 15, 3)  # 1 s at 30 Hz, without the end, which is the start again
    # Frames are 0.2 rad apart; reading at float times blends neighbours by less than 1e-6.
    np.testing.assert_allclose(poses, poses[:1].expand_as(poses), atol=1e-5)
    elbow = skeleton.body_names.index("left_lower_arm")
    along_arm = poses[0, elbow] - poses[0, shoulder]
    x, y, z = skeleton.local_translation[elbow]
    np.testing.assert_allclose(along_arm, [-z, y, x], atol=1e-5)  # down has become forward


class TestRecorder:
    """Two environments of two bodies; body 1 of environment e at step k is at x = 10 e + k."""

    @staticmethod
    def step(recorder, k, num_envs=2):
        body_pos_w = torch.zeros(num_envs, 2, 3)
        body_pos_w[:, 1, 0] = 10.0 * torch.arange(num_envs) + k
        recorder.record(body_pos_w, torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(num_envs, 4))

    @staticmethod
    def steps_of(episode):
        return episode.poses[:, 1, 0].tolist()

    def test_keeps_one_episode_of_each_environment(self):
        recorder = EpisodeRecorder(2, 2, max_steps=5, device="cpu")
        for k in range(6):
            self.step(recorder, k)
            if k in (1, 3):  # environment 0 ends twice
                recorder.finish(torch.tensor([0]), torch.tensor([True]))
        assert not recorder.complete
        recorder.finish(torch.tensor([], dtype=torch.long), torch.tensor([], dtype=torch.bool))
        recorder.finish(torch.tensor([0, 1]), torch.tensor([False, False]))
        assert recorder.complete
        assert [self.steps_of(e) for e in recorder.episodes] == [
            [0.0, 1.0],
            [10.0, 11.0, 12.0, 13.0, 14.0],  # the sixth step is over max_steps
        ]
        assert [e.fell for e in recorder.episodes] == [True, False]
        assert recorder.episodes[0].poses.dtype == torch.float32

    def test_keeps_several_episodes_when_asked(self):
        recorder = EpisodeRecorder(1, 2, max_steps=5, device="cpu", episodes_per_env=2)
        for k in range(5):
            self.step(recorder, k, num_envs=1)
            if k in (1, 4):
                recorder.finish(torch.tensor([0]), torch.tensor([True]))
        assert [self.steps_of(e) for e in recorder.episodes] == [[0.0, 1.0], [2.0, 3.0, 4.0]]

    def test_can_wait_for_the_next_reset(self):
        recorder = EpisodeRecorder(2, 2, max_steps=5, device="cpu", wait_for_reset=True)
        for k in range(5):
            self.step(recorder, k)
            if k == 1:
                recorder.finish(torch.tensor([1]), torch.tensor([True]))
        recorder.finish(torch.tensor([0, 1]), torch.tensor([True, False]))
        assert [self.steps_of(e) for e in recorder.episodes] == [[12.0, 13.0, 14.0]]
        assert not recorder.complete


def plain_alignment(cost, off_tempo=0.0):
    """(mean cost, advance) of one (T, S) matrix, cell by cell in plain Python."""
    rows, columns = cost.shape
    best = {}
    for t in range(rows):
        for s in range(columns):
            ways = [(0.0, 0, 0)] if t == 0 else []
            for dt, ds in ((1, 0), (0, 1), (1, 1)):
                if (t - dt, s - ds) in best:
                    total, cells, advance = best[t - dt, s - ds]
                    pays = 0.0 if dt == ds else off_tempo
                    ways.append((total + pays, cells, advance + ds))
            total, cells, advance = min(ways)
            best[t, s] = (total + cost[t, s], cells + 1, advance)
    total, cells, advance = min(best[rows - 1, s] for s in range(columns))
    return total / cells, advance


def align_one(cost, **options):
    cost = np.asarray(cost, dtype=float)[:, :, None]
    found = align(cost, *np.array(cost.shape[:2])[:, None], **options)
    return float(found.mean_cost[0]), int(found.advance[0])


def test_two_by_three_computed_by_hand():
    # (0, 0) -> (1, 1) costs 1 + 2; staying in a column costs 1 + 4, 5 + 2 or 4 + 3.
    assert align_one([[1, 5, 4], [4, 2, 3]]) == ((1.0 + 2.0) / 2, 1)


def test_step_along_the_reference_is_a_cell_of_its_own():
    # (0, 0) (1, 1) (1, 2) (2, 3): 0 + 1 + 1 + 0 over four cells.
    cost = [[0, 9, 9, 9], [9, 1, 1, 9], [9, 9, 9, 0]]
    assert align_one(cost) == (0.5, 3)


def test_of_equally_cheap_paths_the_one_with_fewer_cells_counts():
    # (0, 0) (1, 1) (1, 2) (2, 3) and (0, 2) (1, 2) (2, 3) both cost 4.
    cost = [[0, 9, 2, 9], [9, 2, 2, 9], [9, 9, 9, 0]]
    assert align_one(cost) == (4.0 / 3.0, 1)


def test_then_the_one_that_advances_least():
    # All cells cost the same: staying at one reference frame is as cheap as following it.
    assert align_one(np.ones((4, 5))) == (1.0, 0)


def test_path_pays_for_leaving_the_tempo_of_the_reference():
    # Staying in column 0 costs nothing but two steps; going on costs 0.25 in each of two cells.
    cost = [[0, 9, 9], [0, 0.25, 9], [0, 9, 0.25]]
    assert align_one(cost, off_tempo=0.125) == (2 * 0.125 / 3, 0)
    assert align_one(cost, off_tempo=0.5) == (2 * 0.25 / 3, 2)


def test_where_all_frames_are_alike_a_path_that_pays_keeps_the_tempo_of_the_reference():
    assert align_one(np.ones((4, 5)), off_tempo=0.125) == (1.0, 3)
    assert align_one(np.ones((1, 5)), off_tempo=0.125) == (1.0, 0)  # nothing for the first cell


def test_start_and_end_in_the_reference_are_free():
    for start in (0, 3, 6):
        cost = np.ones((4, 10))
        cost[np.arange(4), start + np.arange(4)] = 0.0
        assert align_one(cost) == (0.0, 3)


def test_equals_the_plain_recursion():
    rng = np.random.default_rng(0)
    for _ in range(60):
        shape = rng.integers(1, 9, size=2)
        # Whole numbers make ties; their sums are exact, so that every number must be equal.
        whole = rng.integers(0, 4, size=shape).astype(float)
        assert align_one(whole) == plain_alignment(whole)
        # Both sum along the path in the same order, hence equal to the last bit as well.
        real = rng.random(shape)
        assert align_one(real) == plain_alignment(real)
        assert align_one(whole, off_tempo=1.0) == plain_alignment(whole, 1.0)
        assert align_one(real, off_tempo=0.25) == plain_alignment(real, 0.25)


def test_different_lengths_in_a_batch_equal_one_by_one():
    rng = np.random.default_rng(0)
    cost = rng.random((9, 7, 6))
    lengths = np.array([9, 1, 4, 7, 2, 8])
    expected = []
    for e, rows in enumerate(lengths):
        expected.append(plain_alignment(cost[:rows, :, e])[0])
        cost[rows:, :, e] = np.nan  # what comes after the end may be anything
    np.testing.assert_array_equal(align(cost, lengths, np.full(6, 7)).mean_cost, expected)


def test_more_columns_repeat_the_reference():
    cost = np.random.default_rng(0).random((6, 4, 3))
    found = align(cost, np.full(3, 6), np.array([4, 11, 3]))
    for e, columns in enumerate((4, 11, 3)):
        tiled = np.tile(cost[:, :, e], (1, 3))[:, :columns]
        assert found.mean_cost[e] == plain_alignment(tiled)[0]
