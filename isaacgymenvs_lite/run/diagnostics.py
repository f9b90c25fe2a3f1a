"""Warns when a training with a discriminator goes wrong in a known way, and says what to change.

`Diagnostics` holds the rules: numbers in, warnings out, without an agent, a log or a clock.
`DiagnosticsObserver` gives it the numbers of a training and logs its warnings, which
`docs/reading_a_run.md` lists. The limits are far from what any good training has shown, because a
false alarm costs more than a late one.
"""

from __future__ import annotations

import logging
import math
import statistics
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

from rl_games.common.algo_observer import AlgoObserver

from isaacgymenvs_lite.evaluation.motion_coverage import FallMoment
from isaacgymenvs_lite.run.measurement import MeasurementObserver
from isaacgymenvs_lite.run.metrics import EpochMetrics, MetricsObserver

log = logging.getLogger(__name__)

# A fault must last this long. The discriminator always wins the first 0.5 M frames.
WINDOW_FRAMES = 3_000_000
# The same for small rollouts and large ones: learning needs updates as well as samples.
WINDOW_EPOCHS = 100
# The rules are checked every so many epochs.
CHECK_EPOCHS = 10
# A warning is repeated after this time if its fault lasts.
REPEAT_S = 30 * 60.0

# While a policy learns to stand, episodes get longer by a third and more in a window.
MIN_GROWTH = 1.1
# Below this share of its scale the reward is flat. The discriminator's accuracy is no sign: clips
# are learned well at 0.999. With bad policies that learned, it was 0.07 of its scale and more.
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

# Standing shows a tenth of a clip's motion at most; a policy that stands between its attempts had
# 0.16 to 0.24, one that still learned to move and seldom fell 0.4 and more.
STANDING_SHOWN = 0.3
LAST_MEASUREMENTS = 3
# Keys of task.env that keep an episode to its clip, and the values to propose.
CLIP_LIMITS = {"clipDeviation": 0.34, "clipTravel": 0.5, "clipTempo": 0.3}
# Poses of a clip that moves are this far from their average; walk and run have 0.07 to 0.11 m.
MIN_CLIP_SPREAD_M = 0.02

# Walks in quick, short steps, which show all of their clip, had 1.55 to 1.9; slow clips that are
# learned well 1.0 to 1.4. Where no pose of the clip fits such steps in its place, they show all of
# it, too, but had 0.02 to 0.35; a punch that is learned has 0.7.
HASTY_TEMPO = 1.5
LOST_TEMPO = 0.4
MOVES_SHOWN = 0.8
# To propose where the limits are set: walks that began with a policy of another pace found theirs.
NARROW_DEVIATION = 0.2

# As a multiple of the best pose error. In three measurements in a row the trainings that are kept
# in benchmarks/results had at most 1.13, another walk 1.25, and the walk that was lost 2.1.
WORSE_POSE_ERROR = 1.5

# Policies that learned to walk had episodes of more than a tenth of the limit after 2 M frames, and
# one that learned to jump of more than a third after 5 M; both kept getting longer until then.
FALL_FRAMES = 6_000_000
SHORT_SHARE = 0.3
NEARLY_ALL_FALL = 0.9


@dataclass(frozen=True)
class Measurement:
    """One measurement of the mean policy against the clips.

    Attributes:
        frame: environment steps trained before it.
        pose_error_m: see `ImitationResult`; nan if no episode could be measured.
        no_fall_share: share of the episodes without a fall, 0 to 1.
        clip_spread_m: of `imitation.clip_spread_m`; about 0 where a clip does not move.
        motion_shown: see `ImitationResult`.
        tempo: see `ImitationResult`.
        fall_moment: see `ImitationResult`.
    """

    frame: int
    pose_error_m: float
    no_fall_share: float
    clip_spread_m: float
    motion_shown: float = math.nan
    tempo: float = math.nan
    fall_moment: FallMoment | None = None


class RunHistory:
    """Stores the last epochs of a training, and all measurements of the pose error.

    Args:
        window_frames: least number of environment steps in the window.
        window_epochs: least number of epochs in the window.
    """

    def __init__(self, window_frames: int, window_epochs: int) -> None:
        self._window_frames = window_frames
        self._window_epochs = window_epochs
        self._window: deque[EpochMetrics] = deque()
        self._first_frame = 0
        self.measurements: list[Measurement] = []

    def add_epoch(self, metrics: EpochMetrics) -> None:
        """Append an epoch, and drop those that the window no longer needs."""
        if not self._window:
            self._first_frame = metrics.frame
        self._window.append(metrics)
        while len(self._window) > 1 and self._reaches_back_to(self._window[1]):
            self._window.popleft()

    def _reaches_back_to(self, epoch: EpochMetrics) -> bool:
        newest = self._window[-1]
        return (
            newest.frame - epoch.frame >= self._window_frames
            and newest.epoch - epoch.epoch >= self._window_epochs
        )

    @property
    def newest(self) -> EpochMetrics:
        """The newest epoch; there must be one."""
        return self._window[-1]

    @property
    def window_is_full(self) -> bool:
        """Whether the run is as long as the window."""
        return len(self._window) > 0 and self._reaches_back_to(self._window[0])

    @property
    def window_frames(self) -> int:
        """Environment steps in the window."""
        return self._window[-1].frame - self._window[0].frame

    @property
    def frames_trained(self) -> int:
        """Environment steps of this run; a resumed one counts its own."""
        return self._window[-1].frame - self._first_frame

    def median(self, metric: Callable[[EpochMetrics], float | None]) -> float:
        """Return the median of a metric over the window; nan if it is unknown."""
        return _median([metric(epoch) for epoch in self._window])

    def growth(self, metric: Callable[[EpochMetrics], float | None]) -> float:
        """Return a metric's median over the window's last third, divided by the first third's.

        Nan if the metric is unknown or 0 in the first third.
        """
        values = [metric(epoch) for epoch in self._window]
        third = max(1, len(values) // 3)
        before = _median(values[:third])
        return _median(values[-third:]) / before if before != 0 else math.nan

    def measured(self, after: float = -math.inf, until: float = math.inf) -> list[Measurement]:
        """Return the measurements at frames in (after, until] that have a pose error."""
        return [
            measurement
            for measurement in self.measurements
            if after < measurement.frame <= until and math.isfinite(measurement.pose_error_m)
        ]

    def pose_error_improved_since(self, frame: float, by: float) -> bool:
        """Return whether the best pose error after `frame` is lower than before, by the share `by`.

        Also True while one of the two is unknown.
        """
        before = [measurement.pose_error_m for measurement in self.measured(until=frame)]
        after = [measurement.pose_error_m for measurement in self.measured(after=frame)]
        return not before or not after or min(after) < (1.0 - by) * min(before)


def _median(values: list[float | None]) -> float:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else math.nan


class Diagnostics:
    """Finds known faults of a training in its metrics.

    Args:
        config: `train.params.config`, for the values that a warning proposes.
        max_episode_steps: the task's time limit in control steps.
        clip_limits: the keys of `CLIP_LIMITS` that the task sets.

    Attributes:
        history: what the rules read.
        implausible: what is implausible in the clips, for users; '' if nothing is known.
        clip_limits: as given.
    """

    def __init__(
        self,
        config: Mapping[str, Any],
        max_episode_steps: int,
        clip_limits: Collection[str] = (),
    ) -> None:
        self._config = config
        self._max_episode_steps = max_episode_steps
        self.clip_limits = clip_limits
        self.implausible = ""
        self.history = RunHistory(WINDOW_FRAMES, WINDOW_EPOCHS)
        self._warned_s: dict[str, float] = {}
        # The first that applies is the warning: the later ones may be its consequences.
        self._rules: dict[str, Callable[[], str | None]] = {
            "no reward": self._no_reward,
            "discriminator fooled": self._discriminator_fooled,
            "standing still": self._standing_still,
            "gets worse": self._gets_worse,
            "in a hurry": self._in_a_hurry,
            "falls": self._falls,
            "no improvement": self._no_improvement,
        }

    def add_epoch(self, metrics: EpochMetrics) -> None:
        """Store the metrics of the next epoch."""
        self.history.add_epoch(metrics)

    def add_measurement(self, measurement: Measurement) -> None:
        """Store a measurement of the pose error."""
        self.history.measurements.append(measurement)

    def next_warning(self, now_s: float) -> str | None:
        """Return what is wrong and what to do about it, or None.

        Args:
            now_s: time of any clock; a warning is repeated after `REPEAT_S`.
        """
        if self.history.newest.epoch % CHECK_EPOCHS != 0 or not self.history.window_is_full:
            return None
        for kind, rule in self._rules.items():
            warning = rule()
            if warning is not None:
                return warning if self._is_due(kind, now_s) else None
        return None

    def _is_due(self, kind: str, now_s: float) -> bool:
        if now_s - self._warned_s.get(kind, -math.inf) < REPEAT_S:
            return False
        self._warned_s[kind] = now_s
        return True

    # --- rules -----------------------------------------------------------------------------

    def _no_reward(self) -> str | None:
        history = self.history
        if self._config.get("disc_reward_w", 1.0) == 0 or self._policy_learns():
            return None
        scale = float(self._config.get("disc_reward_scale", 1.0)) or 1.0
        reward = history.median(lambda epoch: epoch.style_reward)
        if not reward / scale < NO_REWARD or not self._policy_is_bad():
            return None
        return (
            f"the style reward has vanished: for {_millions(history.window_frames)} frames it was"
            f" {reward:.3f} a step and episodes did not get longer ({self._steps():.0f} steps), so"
            " that the policy cannot see what would be better; start again with"
            f" {self._turn('disc_grad_penalty', 2.0)}, {self._turn(self._disc_rate, 0.5)} or"
            f" {self._turn('amp_minibatch_size', 0.5)}"
        )

    def _discriminator_fooled(self) -> str | None:
        history = self.history
        accuracy = history.median(lambda epoch: epoch.disc_accuracy)
        if not accuracy < FOOLED_ACCURACY or self._policy_learns():
            return None
        measured = history.measured()
        if measured:
            if measured[-1].pose_error_m <= _good_m(measured[-1]):
                return None
            although = f"the pose error is {measured[-1].pose_error_m:.3f} m"
        elif self._early_end_rate() > MOSTLY_FALLS:
            although = f"{self._early_end_rate():.0%} of the episodes end {self._early_end()}"
        else:
            return None
        return (
            f"the discriminator is fooled: for {_millions(history.window_frames)} frames it was"
            f" right about {accuracy:.0%} of the samples (50% is guessing), although {although},"
            f" so that anything is rewarded; try {self._turn('disc_grad_penalty', 0.5)},"
            f" {self._turn(self._disc_rate, 2.0)} or {self._turn('amp_minibatch_size', 2.0)}"
        )

    def _newest_of_faulty(self, is_faulty: Callable[[Measurement], bool]) -> Measurement | None:
        """Return the newest measurement if the last are of a faulty policy that stays up.

        A clip that hardly moves shows no such fault.
        """
        last = self.history.measured()[-LAST_MEASUREMENTS:]
        faulty = [
            one
            for one in last
            if one.no_fall_share > MOSTLY_FALLS
            and one.clip_spread_m > MIN_CLIP_SPREAD_M
            and is_faulty(one)
        ]
        return last[-1] if len(faulty) == LAST_MEASUREMENTS else None

    def _missing_limits(self, *keys: str) -> list[str]:
        """Return the command line's words for `keys` of `CLIP_LIMITS` that the task leaves at 0."""
        return [
            f"task.env.{key}={CLIP_LIMITS[key]:g}" for key in keys if key not in self.clip_limits
        ]

    def _standing_still(self) -> str | None:
        newest = self._newest_of_faulty(_is_still)
        if newest is None:
            return None
        # A training that still ends its episodes: on a clip of the ground only the distance does.
        if self._early_end_rate() > NEARLY_ALL_FALL:
            return None
        cut = "cut parts without motion out of the clips"
        missing = self._missing_limits("clipDeviation", "clipTravel")
        if missing:
            cut = (
                f"set {' and '.join(missing)}: episodes that stay behind their clip end"
                f" (with one clip in task.env.motion_file); or {cut}"
            )
        return (
            f"the policy stands still: in the last {LAST_MEASUREMENTS} measurements its episodes"
            f" seldom ended in a fall, but they show {newest.motion_shown:.0%} of the clips'"
            f" motion; {cut}{self._clips_are_odd()}"
        )

    def _in_a_hurry(self) -> str | None:
        newest = self._newest_of_faulty(_is_hasty)
        if newest is None:
            return None
        missing = self._missing_limits("clipDeviation", "clipTempo")
        end = "which ends such episodes in training (with one clip in task.env.motion_file)"
        if not missing:
            missing = [f"a smaller task.env.clipDeviation, such as {NARROW_DEVIATION:g}"]
            end = "which ends such episodes sooner, or begin without a policy in checkpoint="
        seen = "it was faster than its clip" if newest.tempo > 1.0 else "it had no pace of its clip"
        return (
            f"the policy is in a hurry: in the last {LAST_MEASUREMENTS} measurements {seen}, now"
            f" {newest.tempo:.2f} times, as if in quick, short steps; set {' and '.join(missing)},"
            f" {end}"
        )

    def _gets_worse(self) -> str | None:
        measured = self.history.measured()
        earlier, last = measured[:-LAST_MEASUREMENTS], measured[-LAST_MEASUREMENTS:]
        good = [one for one in earlier if one.no_fall_share > MOSTLY_FALLS and not _is_still(one)]
        best = min(good, key=lambda one: one.pose_error_m, default=None)
        if best is None:
            return None
        least_m = min(one.pose_error_m for one in last)
        if least_m < WORSE_POSE_ERROR * best.pose_error_m:
            return None
        rate = self._turn("learning_rate", 0.5)
        if self._config.get("lr_schedule") == "constant":
            rate = f"train.params.config.lr_schedule=linear, or {rate}"
        return (
            f"the policy gets worse: its pose error was {best.pose_error_m:.3f} m after"
            f" {_millions(best.frame)} frames, and at least {least_m:.3f} m in the last"
            f" {LAST_MEASUREMENTS} measurements; go on from a checkpoint of then with smaller"
            f" steps: {rate}"
        )

    def _falls(self) -> str | None:
        history = self.history
        if history.frames_trained < FALL_FRAMES or self._policy_learns():
            return None
        last = history.measured()[-LAST_MEASUREMENTS:]
        # Exploration may make a good policy fall.
        stays_up = bool(last) and all(one.no_fall_share > MOSTLY_FALLS for one in last)
        is_short = self._steps() < SHORT_SHARE * self._max_episode_steps
        if stays_up or not (is_short and self._early_end_rate() > NEARLY_ALL_FALL):
            return None
        moment = last[-1].fall_moment if last else None
        where = ""
        if moment is not None:
            where = (
                f", {moment.share:.0%} of the falls from {moment.time_s:.1f} s of clip"
                f" {moment.clip + 1} on"
            )
        return (
            f"after {_millions(history.frames_trained)} frames of this run episodes still end"
            f" {self._early_end()} after {self._steps():.0f} of {self._max_episode_steps}"
            f" steps{where}; try"
            " task.env.adaptiveStarts=0.5, which practises where the policy falls, and make sure"
            " that task.env.contactBodies has every body with which the clip touches the ground"
            f" (null finds them){self._clips_are_odd()}"
        )

    def _clips_are_odd(self) -> str:
        """Return the end of a sentence about what no policy can imitate in the clips."""
        return f"; no body does what the clips do: {self.implausible}" if self.implausible else ""

    def _no_improvement(self) -> str | None:
        history = self.history
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
        return self.history.growth(lambda epoch: epoch.episode_steps) >= MIN_GROWTH

    def _policy_learns(self) -> bool:
        """Return whether episodes get longer or, where it is measured, the pose error lower."""
        history = self.history
        since = history.newest.frame - history.window_frames
        return self._episodes_get_longer() or (
            bool(history.measured()) and history.pose_error_improved_since(since, MIN_IMPROVEMENT)
        )

    def _policy_is_bad(self) -> bool:
        """Return whether most episodes end in a fall, or the pose error is high."""
        measured = self.history.measured()
        unlike = bool(measured) and measured[-1].pose_error_m > BAD_POSE_ERROR * _good_m(
            measured[-1]
        )
        return self._early_end_rate() > MOSTLY_FALLS or unlike

    def _early_end_rate(self) -> float:
        """Return the share of the episodes that end early, also off the clip."""
        return self.history.median(lambda epoch: epoch.early_end_rate)

    def _early_end(self) -> str:
        """Return how episodes end before the time limit."""
        off_clip = self.history.median(lambda epoch: epoch.off_clip_rate)
        return f"in a fall or off the clip ({off_clip:.0%})" if off_clip > 0.0 else "in a fall"

    def _steps(self) -> float:
        return self.history.median(lambda epoch: epoch.episode_steps)

    @property
    def _disc_rate(self) -> str:
        """The key of the discriminator's learning rate: its own, or the shared one."""
        return "disc_learning_rate" if self._config.get("disc_learning_rate") else "learning_rate"

    def _turn(self, key: str, factor: float) -> str:
        """Return `train.params.config.<key>=<factor * value> (now <value>)`."""
        value = self._config.get(key)
        name = f"train.params.config.{key}"
        if not isinstance(value, (int, float)) or value == 0:
            return name
        return f"{name}={factor * value:g} (now {value:g})"


def _is_still(measurement: Measurement) -> bool:
    return measurement.motion_shown < STANDING_SHOWN


def _is_hasty(measurement: Measurement) -> bool:
    is_lost = measurement.tempo < LOST_TEMPO and measurement.motion_shown > MOVES_SHOWN
    return measurement.tempo > HASTY_TEMPO or is_lost


def _good_m(measurement: Measurement) -> float:
    """Return the pose error in m that is good enough; larger where the clip moves more."""
    wide_m = GOOD_SHARE_OF_SPREAD * measurement.clip_spread_m
    return max(GOOD_POSE_ERROR_M, wide_m) if math.isfinite(wide_m) else GOOD_POSE_ERROR_M


def _millions(frames: float) -> str:
    return f"{frames / 1e6:.1f} M"


class DiagnosticsObserver(AlgoObserver):
    """Logs the warnings of `Diagnostics`, and writes them to TensorBoard as the text `advice`.

    It must come after the observers that it reads. Numbers that are not finite end the run before
    (`learning.safeguards`).

    Args:
        metrics: the epochs' metrics.
        imitation: the measured pose error, if any.
        max_episode_steps: the task's time limit in control steps.
        clip_limits: the keys of `CLIP_LIMITS` that the task sets.

    Attributes:
        diagnostics: the rules; set once there is an agent.
    """

    stored = ()

    def __init__(
        self,
        metrics: MetricsObserver,
        imitation: MeasurementObserver | None,
        max_episode_steps: int,
        clip_limits: Collection[str] = (),
    ) -> None:
        super().__init__()
        self._metrics = metrics
        self._imitation = imitation
        self._max_episode_steps = max_episode_steps
        self._clip_limits = clip_limits

    def after_init(self, algo: Any) -> None:
        """Store the agent."""
        self._algo = algo
        limit = self._max_episode_steps
        self.diagnostics = Diagnostics(algo.config, limit, self._clip_limits)
        self._measured_at: int | None = None

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        """Pass on what is new, and log the warning that is due."""
        if self._metrics.latest is None:
            return
        self.diagnostics.add_epoch(self._metrics.latest)
        self._add_measurement()
        warning = self.diagnostics.next_warning(time.monotonic())
        if warning is not None:
            log.warning("%s", warning)
            self._algo.writer.add_text("advice", warning, frame)

    def _add_measurement(self) -> None:
        observer = self._imitation
        if observer is None or observer.last_frame == self._measured_at:
            return
        self._measured_at = observer.last_frame
        result = observer.last.imitation if observer.last is not None else None
        if result is not None and observer.last_frame is not None:
            self.diagnostics.add_measurement(
                Measurement(
                    frame=observer.last_frame,
                    pose_error_m=result.pose_error_m,
                    no_fall_share=result.no_fall_share,
                    clip_spread_m=observer.clip_spread_m,
                    motion_shown=result.motion_shown,
                    tempo=result.tempo,
                    fall_moment=result.fall_moment,
                )
            )
            self.diagnostics.implausible = observer.implausible
