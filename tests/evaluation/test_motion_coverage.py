"""The share of the clips' motion: all for the clip itself, next to nothing for standing still."""

from __future__ import annotations

import pytest
import torch

from isaacgymenvs_lite.evaluation.body_tracks import Track, tracks_of_clips
from isaacgymenvs_lite.evaluation.motion_coverage import MotionCoverage
from isaacgymenvs_lite.evaluation.pose_error import (
    EpisodeRecorder,
    PoseErrorMetric,
    ReferencePoses,
)
from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.utils.rotations import quat_from_angle_axis, rotate_about_z

DT_S = 1.0 / 30.0
STEPS = 300
KEY_BODIES = (5, 8, 11, 14)


def library(name: str) -> MotionLib:
    return MotionLib(name, 28, KEY_BODIES, "cpu", True, interpolation="spline")


def played(name: str, steps: int = STEPS, phase: float = 0.0, tempo: float = 1.0) -> Track:
    """An episode of a clip that goes on from where it ends, beginning at a share of its length."""
    lib = library(name)
    length_s = float(lib.get_motion_length([0]))
    times_s = phase * length_s + tempo * DT_S * torch.arange(steps, dtype=torch.float64)
    ids, in_clip_s = torch.zeros(steps, dtype=torch.long), times_s % length_s
    ends = lib.get_motion_state([0, 0], [0.0, length_s]).root_pos
    moved = ends[1] - ends[0]
    moved[2] = 0.0
    repetitions = torch.floor(times_s / length_s).float().view(-1, 1, 1)
    body_pos_w = lib.get_body_pos(ids, in_clip_s) + repetitions * moved
    return Track(body_pos_w, lib.get_motion_state(ids, in_clip_s).root_rot)


def coverage(*names: str) -> MotionCoverage:
    libs = [library(name) for name in names]
    return MotionCoverage([track for lib in libs for track in tracks_of_clips(lib, DT_S)], DT_S)


def turned(track: Track, angle_rad: float) -> Track:
    """The same, heading elsewhere, at another place."""
    angle = torch.tensor(angle_rad)
    about_z = quat_from_angle_axis(angle, torch.tensor([0.0, 0.0, 1.0]))
    x, y, z, w = track.root_rot_w.unbind(-1)
    s, c = about_z[2], about_z[3]
    rot = torch.stack((c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z), dim=-1)
    place = torch.tensor([5.0, -3.0, 0.0])
    return Track(rotate_about_z(angle.cos(), angle.sin(), track.body_pos_w) + place, rot)


@pytest.mark.parametrize("name", ["jump", "turn_left", "stand"])
def test_the_clip_itself_shows_all_whatever_phase_place_and_heading(name):
    measured = coverage(name)
    for start in (0.0, 0.4, 0.8):
        episode = turned(played(name, phase=start), 2.0)
        assert measured.share([episode], STEPS) > 0.95


@pytest.mark.parametrize("name", ["turn_left", "crouch_walk"])
def test_standing_shows_next_to_nothing(name):
    assert coverage(name).share([played("stand")], STEPS) < 0.15
    frozen = played(name, steps=1)
    still = Track(frozen.body_pos_w.expand(STEPS, -1, -1), frozen.root_rot_w.expand(STEPS, -1))
    assert coverage(name).share([still], STEPS) < 0.15


def test_who_starts_in_a_walk_and_stops_has_shown_no_more_than_it_walked():
    """The poses of a crouched walk are alike: half a second of it is near all of its moments."""
    walked = played("crouch_walk", 20)
    stopped = Track(
        torch.cat((walked.body_pos_w, walked.body_pos_w[-1:].expand(STEPS - 20, -1, -1))),
        torch.cat((walked.root_rot_w, walked.root_rot_w[-1:].expand(STEPS - 20, -1))),
    )
    length_s = library("crouch_walk").get_total_length()
    # Those that begin in the walk and end after the stop count in part.
    assert coverage("crouch_walk").share([stopped], STEPS) < 1.5 * 20 * DT_S / length_s


def test_walking_on_the_spot_is_not_walking():
    track = played("walk")
    on_the_spot = track.body_pos_w.clone()
    on_the_spot[..., :2] -= track.body_pos_w[:, :1, :2]
    assert coverage("walk").share([Track(on_the_spot, track.root_rot_w)], STEPS) < 0.3


def test_half_as_fast_is_half_of_a_run_and_a_little_slower_is_all():
    measured = coverage("run")
    assert measured.share([played("run", tempo=0.5)], STEPS) < 0.7
    assert measured.share([played("run", tempo=0.9)], STEPS) > 0.9


def test_what_a_fall_leaves_out_is_missing():
    """A second of the jump of three seconds, wherever it begins."""
    measured = coverage("jump")
    seconds = [played("jump", steps=30, phase=share) for share in (0.0, 0.3, 0.6)]
    assert measured.share(seconds, STEPS) < 0.75
    assert measured.share([played("jump", steps=3)], STEPS) < 0.05


def test_one_clip_of_two_is_a_part():
    measured = coverage("walk", "run")
    walked = measured.share([played("walk")], STEPS)
    assert 0.15 < walked < 0.6
    both = Track(
        torch.cat((played("walk", 150).body_pos_w, played("run", 150).body_pos_w)),
        torch.cat((played("walk", 150).root_rot_w, played("run", 150).root_rot_w)),
    )
    assert measured.share([both], STEPS) > 0.9


def test_of_a_clip_longer_than_an_episode_as_much_is_expected_as_fits():
    walked = played("walk", 900)
    slowly = MotionCoverage([Track(walked.body_pos_w, walked.root_rot_w)], DT_S)
    assert slowly.share([played("walk", 100)], 100) > 0.95


def test_of_an_episode_that_ends_with_its_clip_the_rest_of_the_clip_counts():
    """Episodes from the first second of the jump to its end, one of which stands."""
    measured = coverage("jump")
    length_s = float(library("jump").get_motion_length([0]))
    rest = played("jump", round((length_s - 1.0) / DT_S), phase=1.0 / length_s)
    stood = played("stand", len(rest))
    assert measured.share_of_rest([(rest, 1.0)]) > 0.95
    assert measured.share_of_rest([(rest, 0.0)]) < 0.75
    assert measured.share_of_rest([(stood, 1.0)]) < 0.15
    mixed = measured.share_of_rest([(rest, 1.0), (stood, 1.0)])
    alone = [measured.share_of_rest([(track, 1.0)]) for track in (rest, stood)]
    assert mixed == pytest.approx(sum(alone) / 2)


def test_who_gets_up_later_has_another_median_height_and_still_gets_up():
    """A walk that rises by a metre, alone and after two seconds at its first place."""
    walked = played("walk", 90)
    rising = walked.body_pos_w + torch.linspace(0.0, 1.0, 90)[:, None, None] * torch.tensor(
        [0.0, 0.0, 1.0]
    )
    clip = Track(rising, walked.root_rot_w)
    late = Track(
        torch.cat((rising[:1].expand(60, -1, -1), rising)),
        torch.cat((walked.root_rot_w[:1].expand(60, -1), walked.root_rot_w)),
    )
    measured = MotionCoverage([clip], DT_S)
    for episode in (clip, late):
        assert measured.share_of_rest([(episode, 0.0)]) == pytest.approx(1.0)
    rest = Track(rising[60:], walked.root_rot_w[60:])
    assert measured.share_of_rest([(rest, 60 * DT_S)]) == pytest.approx(1.0)


def test_where_falls_begin():
    """Episodes that follow the jump until 1.5 s, wherever they start, and then lie down."""
    measured = coverage("jump")
    lib = library("jump")
    length_s = float(lib.get_motion_length([0]))

    def falling(start_s: float, end_s: float) -> Track:
        steps = round((end_s - start_s) / DT_S)
        followed = played("jump", steps, phase=start_s / length_s)
        lying = followed.body_pos_w[-1:].expand(20, -1, -1) * torch.tensor([1.0, 1.0, 0.1])
        rot = followed.root_rot_w[-1:].expand(20, -1)
        return Track(torch.cat((followed.body_pos_w, lying)), torch.cat((followed.root_rot_w, rot)))

    found = measured.fall_moment([falling(start_s, 1.5) for start_s in (0.0, 0.2, 0.4, 0.6)])
    assert found is not None
    assert (found.clip, found.share) == (0, 1.0)
    # A moment is seen at its first time; the last one ends at the fall.
    assert 0.4 < found.time_s < 1.6
    ends_s = (0.9, 1.3, 1.7, 2.1, 2.5)
    assert measured.fall_moment([falling(0.0, end_s) for end_s in ends_s]) is None
    assert measured.fall_moment([falling(0.0, 1.5)] * 3) is None  # too few


def test_the_metric_measures_recorded_episodes():
    clip = played("walk", 109)
    recorder = EpisodeRecorder(1, 15, 300, "cpu", episodes_per_env=2)
    for name in ("walk", "stand"):
        track = played(name, 300)
        for body_pos, root_rot in zip(track.body_pos_w, track.root_rot_w, strict=True):
            recorder.record(body_pos.unsqueeze(0), root_rot.unsqueeze(0))
        recorder.finish(torch.tensor([0]), torch.tensor([False]))
    metric = PoseErrorMetric(ReferencePoses.from_tracks([clip]), MotionCoverage([clip], DT_S))
    walked, stood = (metric.evaluate([episode]).motion_shown for episode in recorder.episodes)
    assert walked > 0.95
    assert stood < 0.15
    assert f"{walked:.0%} of the motion" in str(metric.evaluate(recorder.episodes[:1]))
