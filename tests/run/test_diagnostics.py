from __future__ import annotations

import logging
from collections.abc import Callable, Collection
from typing import Any

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.run.diagnostics import (
    REPEAT_S,
    DiagnosticsObserver,
    Measurement,
)
from isaacgymenvs_lite.run.measurement import MeasurementObserver
from isaacgymenvs_lite.run.metrics import EpochMetrics, MetricsObserver

EPOCH_FRAMES = 16384
EPOCH_S = 4.0
CONFIG = {
    "disc_reward_w": 1.0,
    "disc_reward_scale": 2,
    "disc_grad_penalty": 5,
    "learning_rate": 2e-4,
    "amp_minibatch_size": 512,
}

# A training that learned to walk (mocap walk, 1024 environments, learning rate 2e-4, 3
# mini-epochs): frames, episode steps, style reward, accuracy of agent and demo samples.
WALK = np.array(
    [
        (0, 7.4, 4.204, 0.673, 0.839),
        (32768, 11.1, 0.156, 0.975, 1.000),
        (98304, 15.4, 0.142, 0.975, 1.000),
        (196608, 17.2, 0.166, 0.969, 1.000),
        (294912, 19.0, 0.293, 0.945, 1.000),
        (393216, 17.6, 0.320, 0.939, 1.000),
        (491520, 16.8, 0.414, 0.915, 1.000),
        (737280, 20.7, 0.532, 0.921, 1.000),
        (983040, 24.6, 0.628, 0.920, 1.000),
        (1228800, 30.3, 0.607, 0.945, 1.000),
        (1474560, 35.0, 0.657, 0.950, 1.000),
        (1802240, 37.2, 0.749, 0.948, 1.000),
        (2457600, 49.9, 0.732, 0.958, 1.000),
        (2949120, 65.3, 0.705, 0.978, 1.000),
        (3276800, 123.5, 0.710, 0.985, 1.000),
        (3604480, 217.6, 0.750, 0.992, 1.000),
        (4259840, 274.9, 0.758, 0.993, 1.000),
        (4915200, 288.2, 0.856, 0.996, 1.000),
        (6537216, 290.8, 0.877, 0.992, 1.000),
    ]
)
# Frames, pose error, tempo, share without a fall; the mean policy of that training.
WALK_MEASURED = np.array(
    [
        (802816, 0.151, 0.20, 0.0),
        (1622016, 0.143, 0.65, 0.0),
        (2441216, 0.110, 0.79, 0.0),
        (3260416, 0.067, 1.06, 1.0),
        (4079616, 0.064, 1.19, 1.0),
        (4898816, 0.062, 1.15, 1.0),
        (5718016, 0.057, 1.13, 1.0),
        (6537216, 0.055, 1.13, 1.0),
        (30000000, 0.045, 1.05, 1.0),  # what longer trainings come to
    ]
)


def walk(frame: float) -> dict[str, float]:
    steps, style, agent, demo = (np.interp(frame, WALK[:, 0], column) for column in WALK.T[1:])
    falls = np.interp(steps, [50.0, 290.0], [1.0, 0.05])
    return {"steps": steps, "falls": falls, "style": style, "agent": agent, "demo": demo}


def measured_walk(frame: float) -> dict[str, float]:
    names = ("pose_error_m", "no_fall_share")
    columns = WALK_MEASURED.T[[1, 3]]
    return {
        name: float(np.interp(frame, WALK_MEASURED[:, 0], column))
        for name, column in zip(names, columns, strict=True)
    }


def walking(frame: float) -> dict[str, float]:
    """Epochs of a policy that can walk."""
    del frame
    return walk(7e6)


def measuring(
    pose_error_m: float, no_fall_share: float = 1.0, **others: Any
) -> Callable[[float], dict[str, Any]]:
    """Measurements that are always the same."""
    values = {"pose_error_m": pose_error_m, "no_fall_share": no_fall_share}
    return lambda _: {**values, **others}


def metrics(epoch: int, frame: int, values: dict[str, float]) -> EpochMetrics:
    info = {
        "disc_reward_mean": values["style"],
        "disc_agent_acc": values["agent"],
        "disc_demo_acc": values["demo"],
    }
    lengths = (values["steps"], values["steps"])
    return EpochMetrics(epoch, frame, *lengths, values["falls"], values.get("off_clip"), info)


def judge(config: dict[str, Any], clip_limits: Collection[str] = ()) -> DiagnosticsObserver:
    """The rules alone, for episodes of 300 steps."""
    diagnostics = DiagnosticsObserver(MetricsObserver(), None, 300, clip_limits)
    diagnostics.config = config
    return diagnostics


def warnings_of(
    epoch_values: Callable[[float], dict[str, float]],
    measured: Callable[[float], dict[str, float]] | None = measured_walk,
    frames: int = 8_000_000,
    spread_m: float = 0.1,
    clip_limits: Collection[str] = (),
    **config: Any,
) -> list[tuple[int, str]]:
    """[(frame, warning)] of a run; a measurement every 50 epochs."""
    diagnostics = judge({**CONFIG, **config}, clip_limits)
    warnings = []
    for epoch in range(1, frames // EPOCH_FRAMES + 1):
        frame = (epoch - 1) * EPOCH_FRAMES
        if measured is not None and epoch % 50 == 0:
            diagnostics.measurements.append(
                Measurement(frame, clip_spread_m=spread_m, **measured(frame))
            )
        warning = diagnostics.next_warning(
            metrics(epoch, frame, epoch_values(frame)), epoch * EPOCH_S
        )
        if warning is not None:
            warnings.append((frame, warning))
    return warnings


# --- trainings that come out well -------------------------------------------------------------


@pytest.mark.parametrize("slowness", [1.0, 3.0])
def test_a_training_that_learns_to_walk_is_not_disturbed(slowness):
    warnings = warnings_of(
        lambda frame: walk(frame / slowness),
        lambda frame: measured_walk(frame / slowness),
        frames=int(40_000_000 * slowness),
    )
    assert warnings == []


def test_an_agent_without_a_discriminator_gets_no_warning():
    diagnostics = judge({})
    for epoch in range(1, 1000):
        numbers = {"actor_loss": 0.1}
        metrics = EpochMetrics(epoch, epoch * EPOCH_FRAMES, 20.0, 1.0, 0.5, None, numbers)
        assert diagnostics.next_warning(metrics, epoch * EPOCH_S) is None


# --- the style reward has vanished ------------------------------------------------------------

BAD = measuring(0.2, no_fall_share=0.0)
# What a training showed with a learning rate of 1e-3, no gradient penalty and large minibatches.
LOST = {"steps": 6.5, "falls": 1.0, "style": 0.002, "agent": 0.999, "demo": 1.0}


def test_a_reward_that_is_gone_for_long():
    (frame, warning), *rest = warnings_of(lambda _: LOST, None)
    assert warning == (
        "the style reward has vanished: for 3.0 M frames it was 0.002 a step and episodes did not"
        " get longer (6 steps), so the policy has nothing to learn from; start again"
        " with train.params.config.disc_grad_penalty=10 (now 5),"
        " train.params.config.learning_rate=0.0001 (now 0.0002) or"
        " train.params.config.amp_minibatch_size=256 (now 512)"
    )
    assert 3_000_000 < frame < 3_300_000
    assert rest == []  # eight million frames are less than half an hour here


def test_a_goal_that_is_reached_without_style():
    """It hopped on one leg towards its goal (HumanoidHeading, ten steps in an AMP observation)."""
    hops = {"steps": 290.0, "falls": 0.02, "style": 0.003, "agent": 1.0, "demo": 1.0}
    (_, warning), *_ = warnings_of(lambda _: hops, None, task_reward_w=0.5, disc_coef=5)
    assert "0.003 a step, so the policy earns the task's reward in a way that no clip" in warning
    assert "train.params.config.disc_reward_w=2 (now 1)" in warning
    assert warnings_of(lambda _: hops, None) == []
    assert warnings_of(lambda _: hops, None, task_reward_w=0.9) == []  # a hierarchy


def test_a_discriminator_that_always_wins_is_no_fault():
    """The run and the hop: accuracies of 0.999, rewards of 0.05 of their scale."""
    winning = {**LOST, "style": 0.1, "steps": 60.0}
    assert warnings_of(lambda _: winning, BAD, frames=5_900_000) == []


def test_a_pose_error_that_improves_shows_that_the_reward_is_useful():
    assert warnings_of(lambda _: LOST, lambda frame: measuring(0.3 - frame / 1e8)(frame)) == []


def test_episodes_that_get_longer_show_that_the_reward_is_useful():
    assert warnings_of(lambda frame: {**LOST, "steps": 6.5 * 1.1 ** (frame / 1e6)}, None) == []


# --- standing still ---------------------------------------------------------------------------


STILL = measuring(0.04, motion_shown=0.12)


def test_a_policy_that_stands_still():
    warning = warnings_of(walking, STILL)[0][1]
    assert warning.startswith("the policy stands still")
    assert "they show 12% of the clips' motion" in warning
    assert "; set task.env.clipDeviation=0.34 and task.env.clipTravel=0.5, which ends" in warning


def test_a_key_that_is_set_is_not_proposed():
    """A slow walk, whose poses are near each other, may stand where only its poses are compared."""
    warning = warnings_of(walking, STILL, clip_limits=["clipDeviation", "clipTempo"])[0][1]
    assert "; set task.env.clipTravel=0.5, which ends" in warning
    warning = warnings_of(walking, STILL, clip_limits=["clipDeviation", "clipTravel"])[0][1]
    assert warning.endswith("cut the parts without motion out of the clips")


def test_other_policies_neither_stand_nor_hurry():
    for measured, spread_m in [
        (STILL, 0.005),  # the clip stands still, too
        (measuring(0.04, motion_shown=0.1, no_fall_share=0.1), 0.1),
        (measuring(0.04, motion_shown=0.8), 0.1),
        (measuring(0.022, motion_shown=0.5, tempo=0.3), 0.1),
        (measuring(0.022, motion_shown=1.0, tempo=1.4), 0.1),
        (measuring(0.022, motion_shown=1.0, tempo=1.76, no_fall_share=0.1), 0.1),
    ]:
        assert warnings_of(walking, measured, spread_m=spread_m) == []


# --- in a hurry -------------------------------------------------------------------------------

HASTY = measuring(0.022, motion_shown=1.0, tempo=1.76)


def test_a_policy_that_takes_quick_steps():
    """As the walk of 14.6 M frames, all of which is shown."""
    for limits, proposed in [
        ([], "set task.env.clipDeviation=0.34 and task.env.clipTempo=0.3,"),
        (["clipDeviation"], "set task.env.clipTempo=0.3,"),
        (["clipDeviation", "clipTempo"], "set a smaller task.env.clipDeviation, such as 0.2,"),
    ]:
        warning = warnings_of(walking, HASTY, clip_limits=limits)[0][1]
        assert warning.startswith("the policy is in a hurry")
        assert "now 1.76 times" in warning
        assert proposed in warning


# --- gets worse -------------------------------------------------------------------------------


def lost_after(frames, later_m, **before):
    """Return measurements of a policy whose pose error is 0.02 m, and after `frames` `later_m`."""
    early = measuring(0.02, **{"motion_shown": 1.0, "tempo": 1.1, **before})
    late = measuring(later_m, motion_shown=1.0, tempo=0.05)
    return lambda frame: early(frame) if frame < frames else late(frame)


def test_a_motion_that_is_lost():
    """As the walk with a constant learning rate, after 37 M frames."""
    frame, warning = warnings_of(walking, lost_after(4_000_000, 0.041), frames=6_000_000)[0]
    assert 4_000_000 < frame < 6_000_000
    assert warning.startswith("the policy gets worse: its pose error was 0.020 m after")
    assert "at least 0.041 m in the last 3 measurements" in warning
    assert "with smaller steps: train.params.config.learning_rate=0.0001 (now 0.0002)" in warning


def test_no_motion_was_lost():
    for later_m, before in [
        (0.028, {}),
        (0.041, {"no_fall_share": 0.1}),  # it fell before it could be far from the clip
        (0.041, {"motion_shown": 0.1}),  # it stood
    ]:
        measured = lost_after(4_000_000, later_m, **before)
        warnings = warnings_of(walking, measured, frames=6_000_000)
        assert not any(warning.startswith("the policy gets worse") for _, warning in warnings)


# --- falls ------------------------------------------------------------------------------------

FALLING = {"steps": 60.0, "falls": 1.0, "style": 0.7, "agent": 0.95, "demo": 1.0}


def test_episodes_that_stay_short():
    frame, warning = warnings_of(lambda _: FALLING, None)[0]
    assert 6_000_000 <= frame < 6_200_000
    assert "after 6.0 M frames of this run episodes still end in a fall after 60 of 300" in warning
    assert "try task.env.adaptiveStarts=0.5" in warning
    assert "task.env.contactBodies" in warning


def test_episodes_that_keep_leaving_their_clip():
    _frame, warning = warnings_of(lambda _: {**FALLING, "off_clip": 0.75}, None)[0]
    assert "still end in a fall or off the clip (75%) after 60 of 300 steps" in warning


# --- when ---------------------------------------------------------------------------------------


def test_a_warning_is_repeated_after_half_an_hour_and_ends_with_the_fault():
    recovery = 20_000_000
    warnings = warnings_of(
        lambda frame: LOST if frame < recovery else walk(7e6), None, frames=40_000_000
    )
    assert len(warnings) >= 2
    seconds = np.diff([frame for frame, _ in warnings]) / EPOCH_FRAMES * EPOCH_S
    assert (seconds >= REPEAT_S).all()
    assert (seconds < REPEAT_S + 100.0).all()
    assert warnings[-1][0] < recovery + 3_000_000


def test_the_cause_is_reported_and_not_its_consequences():
    """Nearly everything falls and nothing improves, too."""
    warnings = warnings_of(lambda _: LOST, BAD, frames=30_000_000)
    assert {warning.split(":")[0] for _, warning in warnings} == {"the style reward has vanished"}


# --- the observer -------------------------------------------------------------------------------


@pytest.fixture
def epoch_metrics(agent) -> MetricsObserver:
    observer = MetricsObserver()
    observer.after_init(agent)
    return observer


@pytest.fixture
def imitation() -> MeasurementObserver:
    return MeasurementObserver(lambda num_envs: None, 0, 16)


@pytest.fixture
def observer(agent, clock, epoch_metrics, imitation) -> DiagnosticsObserver:
    observer = DiagnosticsObserver(epoch_metrics, imitation, max_episode_steps=300)
    observer.after_init(agent)
    return observer


def end_epoch(
    epoch_metrics: MetricsObserver, observer: DiagnosticsObserver, number: int, frame: int
) -> None:
    for one in (epoch_metrics, observer):
        one.after_print_stats(frame, number, 0.0)


def test_a_discriminator_that_has_won_is_reported(observer, epoch_metrics, agent, clock, caplog):
    agent.train_info = {
        "disc_reward_mean": 0.02,
        "disc_agent_acc": 0.999,
        "disc_demo_acc": 1.0,
    }
    agent.game_lengths.update(torch.tensor([[6.0]]))
    with caplog.at_level(logging.INFO):
        for number in range(1, 200):
            clock.now_s += 4.0
            epoch_metrics.process_infos(
                {"terminate": torch.ones(4, dtype=torch.bool)}, torch.arange(4).view(-1, 1)
            )
            end_epoch(epoch_metrics, observer, number, 16384 * number)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "disc_grad_penalty=10 (now 5)" in caplog.messages[0]
    assert [text[:2] for text in agent.writer.texts] == [("advice", caplog.messages[0])]


def test_each_measurement_is_passed_on_once(observer, epoch_metrics, imitation, result):
    end_epoch(epoch_metrics, observer, 1, 1000)
    imitation.last, imitation.last_frame, imitation.clip_spread_m = result, 2000, 0.1
    end_epoch(epoch_metrics, observer, 2, 2000)
    end_epoch(epoch_metrics, observer, 3, 3000)
    imitation.last_frame = 4000
    end_epoch(epoch_metrics, observer, 4, 4000)
    assert observer.measurements == [
        Measurement(2000, 0.123, 0.9, 0.1, 0.87, 1.02),
        Measurement(4000, 0.123, 0.9, 0.1, 0.87, 1.02),
    ]
