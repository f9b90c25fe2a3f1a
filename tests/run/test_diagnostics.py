from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from isaacgymenvs_lite.run import EpochMetrics
from isaacgymenvs_lite.run.diagnostics import REPEAT_S, Diagnostics
from isaacgymenvs_lite.run.history import Measurement

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
    names = ("pose_error_m", "tempo", "no_fall_share")
    columns = WALK_MEASURED.T[1:]
    return {
        name: float(np.interp(frame, WALK_MEASURED[:, 0], column))
        for name, column in zip(names, columns, strict=True)
    }


def walking(frame: float) -> dict[str, float]:
    """Epochs of a policy that can walk."""
    del frame
    return walk(7e6)


def measuring(
    pose_error_m: float, tempo: float = 1.0, no_fall_share: float = 1.0
) -> Callable[[float], dict[str, float]]:
    """Measurements that are always the same."""
    values = {"pose_error_m": pose_error_m, "tempo": tempo, "no_fall_share": no_fall_share}
    return lambda _: values


def figures(epoch: int, frame: int, values: dict[str, float]) -> EpochMetrics:
    info = {
        "disc_reward_mean": values["style"],
        "disc_agent_acc": values["agent"],
        "disc_demo_acc": values["demo"],
    }
    return EpochMetrics(epoch, frame, values["steps"], values["steps"], values["falls"], info)


def told(
    epoch_values: Callable[[float], dict[str, float]],
    measured: Callable[[float], dict[str, float]] | None = measured_walk,
    frames: int = 8_000_000,
    spread_m: float = 0.1,
    config: dict[str, Any] | None = None,
    first_frame: int = 0,
) -> list[tuple[int, str]]:
    """[(frame, sentence)] of a run; a measurement every 50 epochs."""
    advisor = Diagnostics(CONFIG if config is None else config, max_episode_steps=300)
    sentences = []
    for epoch in range(1, frames // EPOCH_FRAMES + 1):
        frame = first_frame + (epoch - 1) * EPOCH_FRAMES
        advisor.add_epoch(figures(epoch, frame, epoch_values(frame)))
        if measured is not None and epoch % 50 == 0:
            advisor.add_measurement(Measurement(frame, clip_spread_m=spread_m, **measured(frame)))
        sentence = advisor.sentence(epoch * EPOCH_S)
        if sentence is not None:
            sentences.append((frame, sentence))
    return sentences


# --- trainings that come out well -------------------------------------------------------------


@pytest.mark.parametrize("slowness", [1.0, 3.0])
def test_a_training_that_learns_to_walk_is_not_disturbed(slowness):
    said = told(
        lambda frame: walk(frame / slowness),
        lambda frame: measured_walk(frame / slowness),
        frames=int(40_000_000 * slowness),
    )
    assert said == []


def test_a_good_pose_error_need_not_improve():
    assert told(walking, measuring(0.045), frames=40_000_000) == []


def test_the_limit_is_wider_where_the_clip_moves_more():
    assert told(walking, measuring(0.11), frames=40_000_000, spread_m=0.25) == []
    assert told(walking, measuring(0.11), frames=40_000_000, spread_m=0.1) != []


def test_a_discriminator_that_guesses_about_a_good_policy_is_right():
    guessing = {**walk(7e6), "agent": 0.5, "demo": 0.5}
    assert told(lambda _: guessing, measuring(0.03), frames=20_000_000) == []


def test_figures_of_an_agent_without_a_discriminator_say_nothing():
    advisor = Diagnostics({}, 300)
    for epoch in range(1, 1000):
        advisor.add_epoch(
            EpochMetrics(epoch, epoch * EPOCH_FRAMES, 20.0, 1.0, 0.5, {"actor_loss": 0.1})
        )
        assert advisor.sentence(epoch * EPOCH_S) is None


# --- the discriminator has won ----------------------------------------------------------------

BAD = measuring(0.2, tempo=0.8, no_fall_share=0.0)
# What a training showed with a learning rate of 1e-3, no gradient penalty and large minibatches.
LOST = {"steps": 6.5, "falls": 1.0, "style": 0.09, "agent": 0.999, "demo": 1.0}


def test_a_discriminator_that_wins_for_long():
    (frame, sentence), *rest = told(lambda _: LOST, None)
    assert sentence == (
        "the discriminator has won: for 3.0 M frames it knew 99.9% of the policy's and 100.0% of"
        " the clips' samples, the style reward was 0.090 and episodes did not get longer (6"
        " steps), so that the policy cannot see what would be better; start again with"
        " train.params.config.disc_grad_penalty=10 (now 5),"
        " train.params.config.learning_rate=0.0001 (now 0.0002) or"
        " train.params.config.amp_minibatch_size=256 (now 512)"
    )
    assert 3_000_000 < frame < 3_300_000
    assert rest == []  # eight million frames are less than half an hour here


def test_a_measured_one_is_told_when_there_is_something_to_compare_with():
    assert 3_000_000 < told(lambda _: LOST, BAD)[0][0] < 4_500_000


def test_a_pose_error_that_improves_shows_that_the_reward_says_something():
    assert told(lambda _: LOST, lambda frame: measuring(0.3 - frame / 1e8)(frame)) == []


def test_a_discriminator_with_a_learning_rate_of_its_own():
    sentence = told(lambda _: LOST, BAD, config={**CONFIG, "disc_learning_rate": 5e-5})[0][1]
    assert "train.params.config.disc_learning_rate=2.5e-05 (now 5e-05)" in sentence
    assert "config.learning_rate" not in sentence


def test_one_that_wins_only_at_first_is_not_told():
    assert told(lambda frame: LOST if frame < 1_500_000 else walk(frame), None) == []


def test_episodes_that_get_longer_show_that_the_reward_says_something():
    assert told(lambda frame: {**LOST, "steps": 6.5 * 1.1 ** (frame / 1e6)}, None) == []


FLAT = {"steps": 299.0, "falls": 0.0, "style": 0.03, "agent": 0.98, "demo": 0.98}


def test_a_reward_near_zero_is_told_whatever_the_accuracy():
    """With enableEarlyTermination: False nobody falls, and the pose error tells."""
    assert "discriminator has won" in told(lambda _: FLAT, measuring(0.25))[0][1]


@pytest.mark.parametrize("values", [FLAT, {**LOST, "steps": 290.0, "falls": 0.05}])
def test_a_discriminator_may_win_against_a_good_policy(values):
    """A low gradient penalty did that to a policy with a pose error of 0.055 m."""
    assert told(lambda _: values, measuring(0.055), frames=12_000_000) == []


def test_without_a_weight_the_style_reward_does_not_matter():
    config = {**CONFIG, "disc_reward_w": 0.0}
    assert told(lambda _: LOST, None, config=config) == []


def test_the_reward_is_compared_with_its_scale():
    assert told(lambda _: LOST, None, config={**CONFIG, "disc_reward_scale": 0.5}) == []


# --- the discriminator is fooled --------------------------------------------------------------

GUESSING = {"steps": 40.0, "falls": 1.0, "style": 1.4, "agent": 0.55, "demo": 0.5}


@pytest.mark.parametrize("measured", [BAD, None])
def test_a_discriminator_that_guesses(measured):
    sentence = told(lambda _: GUESSING, measured)[0][1]
    assert sentence.startswith("the discriminator is fooled")
    assert "disc_grad_penalty=2.5 (now 5)" in sentence
    assert ("0.200 m" if measured else "100% of the episodes") in sentence


def test_guessing_is_no_fault_while_the_pose_error_improves():
    assert told(lambda _: GUESSING, lambda frame: measuring(0.3 - frame / 1e8)(frame)) == []


# --- standing still ---------------------------------------------------------------------------


STILL = measuring(0.04, tempo=0.03)


def test_a_policy_that_stands_still():
    sentence = told(walking, STILL)[0][1]
    assert sentence.startswith("the policy stands still")
    assert "tempo is 0.03" in sentence
    assert "task.env.numAMPObsSteps=4" in sentence


def test_a_policy_that_shall_stand_still():
    assert told(walking, STILL, spread_m=0.005) == []


def test_a_policy_that_falls_does_not_stand():
    assert told(walking, measuring(0.04, tempo=0.03, no_fall_share=0.1)) == []


# --- early falls ------------------------------------------------------------------------------

FALLING = {"steps": 15.0, "falls": 1.0, "style": 0.7, "agent": 0.95, "demo": 1.0}


def test_episodes_that_stay_short():
    frame, sentence = told(lambda _: FALLING, None, frames=12_000_000)[0]
    assert frame >= 10_000_000
    assert "a fall after 15 of 300 steps" in sentence
    assert "task.env.contactBodies" in sentence


def test_a_resumed_run_counts_its_own_frames():
    late = 50_000_000
    assert told(lambda _: FALLING, None, frames=9_000_000, first_frame=late) == []
    assert told(lambda _: FALLING, None, frames=12_000_000, first_frame=late) != []


# --- no improvement ---------------------------------------------------------------------------


def test_a_pose_error_that_stays():
    said = told(
        walking,
        lambda frame: measuring(max(0.08, 0.3 - frame / 2e7))(frame),
        frames=30_000_000,
    )
    frame, sentence = said[0]
    # the best came at 4.4 M: a third of the run ago at 6.6 M, and that third is 5 M at 15 M
    assert 15_000_000 <= frame < 16_000_000
    assert "has not improved for 5.0 M frames" in sentence
    assert "about 0.080 m, the best was 0.080 m" in sentence


def test_a_pose_error_that_gets_worse():
    said = told(walking, lambda frame: measuring(0.04 + frame / 2e8)(frame), frames=30_000_000)
    assert "the best was 0.044 m after 0.8 M" in said[0][1]


def test_few_measurements_prove_nothing():
    def seldom(frame: float) -> dict[str, float]:
        """Every 4 M frames an episode could be measured."""
        known = frame // EPOCH_FRAMES % 250 == 49
        return measuring(0.2 if known else math.nan)(frame)

    assert told(walking, seldom, frames=30_000_000) == []


# --- when ---------------------------------------------------------------------------------------


def test_a_sentence_is_repeated_after_half_an_hour_and_ends_with_the_fault():
    recovery = 20_000_000
    said = told(lambda frame: LOST if frame < recovery else walk(7e6), None, frames=40_000_000)
    assert len(said) >= 2
    seconds = np.diff([frame for frame, _ in said]) / EPOCH_FRAMES * EPOCH_S
    assert (seconds >= REPEAT_S).all()
    assert (seconds < REPEAT_S + 100.0).all()
    assert said[-1][0] < recovery + 3_000_000


def test_the_cause_is_told_and_not_its_consequences():
    """Nearly everything falls and nothing improves, too."""
    said = told(lambda _: LOST, BAD, frames=30_000_000)
    assert {sentence.split(":")[0] for _, sentence in said} == {"the discriminator has won"}


def test_a_short_run_is_not_judged():
    assert told(lambda _: LOST, None, frames=3_000_000) == []
