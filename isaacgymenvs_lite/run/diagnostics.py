"""What is known to go wrong in a training with a discriminator, and the keys to turn.

Numbers in, sentences out: no agent, no log, no clock. `docs/reading_a_run.md` lists the sentences.
The limits lie far from what trainings that came out well showed at any time, because a wrong alarm
costs more than a late one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from isaacgymenvs_lite.run.history import Measurement, RunHistory
from isaacgymenvs_lite.run.metrics import EpochMetrics

# A fault must last this long. The discriminator always wins the first 0.5 M frames.
WINDOW_FRAMES = 3_000_000
# The same for small rollouts and large ones: learning needs updates as well as samples.
WINDOW_EPOCHS = 100
# Medians over the window are taken every so many epochs only.
CHECK_EPOCHS = 10
# A sentence comes again after this time if nothing was done about it.
REPEAT_S = 30 * 60.0

# A training that learns to stand makes episodes longer by a third and more in a window.
MIN_GROWTH = 1.1
# A discriminator wins against good policies as well (0.999 on both sides, and a style reward of a
# few hundredths of `disc_reward_scale` where the gradient penalty is low), so that the policy must
# be bad, too. With a bad one that learned, the reward was at least 0.07 of its scale.
WON_ACCURACY = 0.99
WON_REWARD = 0.1
# Below this share the reward is flat, whatever the accuracy.
NO_REWARD = 0.02
MOSTLY_FALLS = 0.5
# As a multiple of a good pose error.
BAD_POSE_ERROR = 2.0
# 0.5 is guessing.
FOOLED_ACCURACY = 0.6

# Better than most published pose errors; with wide motions half of what a frozen pose would have.
GOOD_POSE_ERROR_M = 0.05
GOOD_SHARE_OF_SPREAD = 0.5
# Two measurements of equally good policies differ by about this share.
MIN_IMPROVEMENT = 0.02
# The last third of a run must have this much before "no improvement" means something.
MIN_STUCK_FRAMES = 5_000_000
MIN_STUCK_MEASUREMENTS = 6

# 1 is the clip's tempo, 0 a frozen pose. Slow motion that was seen to get better had 0.2 and more.
STANDING_TEMPO = 0.2
STANDING_MEASUREMENTS = 3
# Poses of a clip that moves are this far from their average; walk and run have 0.07 to 0.11 m.
MIN_CLIP_SPREAD_M = 0.02

# Episodes that learn to walk are longer than this after 2 M frames.
EARLY_FALL_FRAMES = 10_000_000
EARLY_FALL_SHARE = 0.1
NEARLY_ALL_FALL = 0.9


class Diagnostics:
    """Judges a training from its figures.

    Args:
        config: `train.params.config`, for the values that a sentence proposes.
        max_episode_steps: the task's time limit in control steps.
    """

    def __init__(self, config: Mapping[str, Any], max_episode_steps: int) -> None:
        self._config = config
        self._max_episode_steps = max_episode_steps
        self._history = RunHistory(WINDOW_FRAMES, WINDOW_EPOCHS)
        self._told_s: dict[str, float] = {}
        # The first that applies is told: the later ones may be its consequences.
        self._rules: dict[str, Callable[[], str | None]] = {
            "discriminator won": self._discriminator_won,
            "discriminator fooled": self._discriminator_fooled,
            "standing still": self._standing_still,
            "early falls": self._early_falls,
            "no improvement": self._no_improvement,
        }

    def add_epoch(self, figures: EpochMetrics) -> None:
        """Take the figures of the next epoch."""
        self._history.add_epoch(figures)

    def add_measurement(self, measurement: Measurement) -> None:
        """Take a measurement of the pose error."""
        self._history.measurements.append(measurement)

    def sentence(self, now_s: float) -> str | None:
        """Return what is wrong and what to do, or None.

        Args:
            now_s: any clock; what was told less than `REPEAT_S` ago is not told again.
        """
        if self._history.newest.epoch % CHECK_EPOCHS != 0 or not self._history.window_is_full:
            return None
        for kind, rule in self._rules.items():
            told = rule()
            if told is not None:
                return told if self._may_tell(kind, now_s) else None
        return None

    def _may_tell(self, kind: str, now_s: float) -> bool:
        if now_s - self._told_s.get(kind, -math.inf) < REPEAT_S:
            return False
        self._told_s[kind] = now_s
        return True

    # --- rules -----------------------------------------------------------------------------

    def _discriminator_won(self) -> str | None:
        history = self._history
        if self._config.get("disc_reward_w", 1.0) == 0 or self._policy_learns():
            return None
        scale = float(self._config.get("disc_reward_scale", 1.0)) or 1.0
        reward = history.median(lambda epoch: epoch.style_reward)
        agent = history.median(lambda epoch: epoch.disc_agent_acc)
        demo = history.median(lambda epoch: epoch.disc_demo_acc)
        certain = min(agent, demo) > WON_ACCURACY and reward / scale < WON_REWARD
        if not (certain or reward / scale < NO_REWARD) or not self._policy_is_bad():
            return None
        return (
            f"the discriminator has won: for {_millions(history.window_frames)} frames it knew"
            f" {agent:.1%} of the policy's and {demo:.1%} of the clips' samples, the style reward"
            f" was {reward:.3f} and episodes did not get longer ({self._steps():.0f} steps), so"
            " that the policy cannot see what would be better; start again with"
            f" {self._turn('disc_grad_penalty', 2.0)}, {self._turn(self._disc_rate, 0.5)} or"
            f" {self._turn('amp_minibatch_size', 0.5)}"
        )

    def _discriminator_fooled(self) -> str | None:
        history = self._history
        accuracy = history.median(lambda epoch: epoch.disc_accuracy)
        if not accuracy < FOOLED_ACCURACY or self._policy_learns():
            return None
        measured = history.measured()
        if measured:
            if measured[-1].pose_error_m <= _good_m(measured[-1]):
                return None
            although = f"the pose error is {measured[-1].pose_error_m:.3f} m"
        elif self._fall_rate() > MOSTLY_FALLS:
            although = f"{self._fall_rate():.0%} of the episodes end in a fall"
        else:
            return None
        return (
            f"the discriminator is fooled: for {_millions(history.window_frames)} frames it was"
            f" right about {accuracy:.0%} of the samples (50% is guessing), although {although},"
            f" so that anything is rewarded; try {self._turn('disc_grad_penalty', 0.5)},"
            f" {self._turn(self._disc_rate, 2.0)} or {self._turn('amp_minibatch_size', 2.0)}"
        )

    def _standing_still(self) -> str | None:
        last = self._history.measured()[-STANDING_MEASUREMENTS:]
        if len(last) < STANDING_MEASUREMENTS or not all(_stands(one) for one in last):
            return None
        return (
            f"the policy stands still: in the last {len(last)} measurements its episodes seldom"
            f" ended in a fall, but their tempo is {last[-1].tempo:.2f} (1 is the clip's); cut"
            " parts that stand still out of the clip (task.env.motion_file), or start again with"
            " task.env.numAMPObsSteps=4, which lets the discriminator see more of the motion, or"
            f" {self._turn('disc_grad_penalty', 0.5)}"
        )

    def _early_falls(self) -> str | None:
        history = self._history
        if history.frames_trained < EARLY_FALL_FRAMES or self._episodes_get_longer():
            return None
        short = self._steps() < EARLY_FALL_SHARE * self._max_episode_steps
        if not (short and self._fall_rate() > NEARLY_ALL_FALL):
            return None
        return (
            f"after {_millions(history.frames_trained)} frames of this run episodes still end in a"
            f" fall after {self._steps():.0f} of {self._max_episode_steps} steps; see to it that"
            " task.env.contactBodies has every body with which the clip touches the ground, or"
            " lower task.env.terminationHeight, then try"
            f" {self._turn('disc_grad_penalty', 2.0)} or {self._turn('learning_rate', 0.5)}"
        )

    def _no_improvement(self) -> str | None:
        history = self._history
        third = history.frames_trained / 3
        since = history.newest.frame - third
        late = history.measured(after=since)
        if third < MIN_STUCK_FRAMES or len(late) < MIN_STUCK_MEASUREMENTS:
            return None
        if history.pose_error_improved_since(since, MIN_IMPROVEMENT):
            return None
        typical_m = sorted(one.pose_error_m for one in late)[len(late) // 2]
        if typical_m <= _good_m(late[-1]):
            return None
        best = min(history.measured(), key=lambda one: one.pose_error_m)
        return (
            f"the pose error has not improved for {_millions(third)} frames: it is about"
            f" {typical_m:.3f} m, the best was {best.pose_error_m:.3f} m after"
            f" {_millions(best.frame)}; try {self._turn('learning_rate', 0.5)}, or start again"
            f" with {self._turn('disc_grad_penalty', 0.5)} or twice as much, the key that depends"
            " most on the clip (0.1 to 10)"
        )

    # --- parts of rules --------------------------------------------------------------------

    def _episodes_get_longer(self) -> bool:
        return self._history.growth(lambda epoch: epoch.episode_steps) >= MIN_GROWTH

    def _policy_learns(self) -> bool:
        """Return whether episodes get longer or, where it is measured, the pose error better."""
        history = self._history
        since = history.newest.frame - history.window_frames
        return self._episodes_get_longer() or (
            bool(history.measured()) and history.pose_error_improved_since(since, MIN_IMPROVEMENT)
        )

    def _policy_is_bad(self) -> bool:
        """Return whether most episodes end in a fall, or nothing like the clip is shown."""
        measured = self._history.measured()
        unlike = bool(measured) and measured[-1].pose_error_m > BAD_POSE_ERROR * _good_m(
            measured[-1]
        )
        return self._fall_rate() > MOSTLY_FALLS or unlike

    def _fall_rate(self) -> float:
        return self._history.median(lambda epoch: epoch.fall_rate)

    def _steps(self) -> float:
        return self._history.median(lambda epoch: epoch.episode_steps)

    @property
    def _disc_rate(self) -> str:
        """The key of the discriminator's step size: its own, or the one that it shares."""
        return "disc_learning_rate" if self._config.get("disc_learning_rate") else "learning_rate"

    def _turn(self, key: str, factor: float) -> str:
        """Return `train.params.config.<key>=<factor * value> (now <value>)`."""
        value = self._config.get(key)
        name = f"train.params.config.{key}"
        if not isinstance(value, (int, float)) or value == 0:
            return name
        return f"{name}={factor * value:g} (now {value:g})"


def _stands(measurement: Measurement) -> bool:
    return (
        measurement.tempo < STANDING_TEMPO
        and measurement.no_fall_share > MOSTLY_FALLS
        and measurement.clip_spread_m > MIN_CLIP_SPREAD_M
    )


def _good_m(measurement: Measurement) -> float:
    """Return the pose error that needs no advice; the limit is wider where the clip moves more."""
    wide_m = GOOD_SHARE_OF_SPREAD * measurement.clip_spread_m
    return max(GOOD_POSE_ERROR_M, wide_m) if math.isfinite(wide_m) else GOOD_POSE_ERROR_M


def _millions(frames: float) -> str:
    return f"{frames / 1e6:.1f} M"
