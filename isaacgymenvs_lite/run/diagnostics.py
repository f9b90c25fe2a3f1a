"""Warns when a training with a discriminator goes wrong in a known way, and proposes a change.

`docs/reading_a_run.md` lists the five warnings. The limits are far from the values of good
trainings, because a false alarm does more harm than a late alarm.
"""

from __future__ import annotations

import logging
import math
import statistics
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from rl_games.common.algo_observer import AlgoObserver

from isaacgymenvs_lite.evaluation.motion_coverage import FallMoment
from isaacgymenvs_lite.run.measurement import MeasurementObserver
from isaacgymenvs_lite.run.metrics import EpochMetrics, MetricsObserver

log = logging.getLogger(__name__)

# A warning needs a fault that lasts for so many frames. The discriminator always wins during the
# first 0.5 M frames.
WINDOW_FRAMES, WINDOW_EPOCHS = 3_000_000, 100
CHECK_EPOCHS = 10
REPEAT_S = 30 * 60.0
LAST_MEASUREMENTS = 3

MOSTLY_FALLS, NEARLY_ALL_FALL = 0.5, 0.9
# Relative gain that counts as learning. While a policy learns to stand, its episodes get longer by
# a third and more in `WINDOW_FRAMES`. Measurements of equally good policies differ by about 2%.
MIN_GROWTH, MIN_IMPROVEMENT = 1.1, 0.02
# Style reward, as a share of its scale, below which it has vanished. Bad policies that still
# learned had a share of 0.07 and more.
NO_REWARD = 0.02
BAD_POSE_ERROR_M = 0.1
# `motion_shown` is at most 0.1 for a policy that only stands. It was 0.16 to 0.24 for policies that
# stood still between attempts to move. For policies that still learned to move and seldom fell,
# `motion_shown` was 0.4 and more.
STANDING_SHOWN = 0.3
# A clip with a smaller spread counts as still; walk and run have 0.07 to 0.11 m.
MIN_CLIP_SPREAD_M = 0.02
# The keys of task.env that end episodes which leave their clip, with the proposed values.
CLIP_LIMITS = {"clipDeviation": 0.34, "clipTravel": 0.5, "clipTempo": 0.3}
# The tempo was 1.55 to 1.9 for quick, short steps and 1.0 to 1.4 for slow clips that were learned
# well. If no pose of the clip fits the steps, the tempo was 0.02 to 0.35 although `motion_shown`
# was 1.
HASTY_TEMPO, LOST_TEMPO, MOVES_SHOWN = 1.5, 0.4, 0.8
# Multiple of the best pose error that counts as worse. Good trainings had at most 1.25; a policy
# that forgot how to walk had 2.1.
WORSE_POSE_ERROR = 1.5
# After so many frames, the episodes of policies that learned were longer or were getting longer.
FALL_FRAMES, SHORT_SHARE = 6_000_000, 0.3


@dataclass(frozen=True)
class Measurement:
    """One measurement of the mean policy against the clips; see `ImitationResult`.

    Attributes:
        frame: environment steps before the measurement.
        pose_error_m: nan if no episode could be measured.
        no_fall_share: 0 to 1.
        clip_spread_m: see `measurement.clip_spread_m`; about 0 for a clip without motion.
        motion_shown: 0 to 1.
        tempo: multiple of the clip's tempo.
        fall_moment: the time in the clip at which most falls begin.
    """

    frame: int
    pose_error_m: float
    no_fall_share: float
    clip_spread_m: float
    motion_shown: float = math.nan
    tempo: float = math.nan
    fall_moment: FallMoment | None = None

    @property
    def stays_up(self) -> bool:
        """Whether most episodes end without a fall."""
        return self.no_fall_share > MOSTLY_FALLS

    @property
    def is_still(self) -> bool:
        """Whether the policy stands although the clips move."""
        return self.clip_spread_m > MIN_CLIP_SPREAD_M and self.motion_shown < STANDING_SHOWN

    @property
    def is_hasty(self) -> bool:
        """Whether the policy takes quicker, shorter steps than the clips."""
        is_lost = self.tempo < LOST_TEMPO and self.motion_shown > MOVES_SHOWN
        return self.clip_spread_m > MIN_CLIP_SPREAD_M and (self.tempo > HASTY_TEMPO or is_lost)


class DiagnosticsObserver(AlgoObserver):
    """Logs the warnings and writes them to TensorBoard as the text `advice`.

    This observer must come after the observers `metrics` and `measurement`.

    Args:
        metrics: the epochs' metrics.
        measurement: the observer that measures the pose error, if there is one.
        max_episode_steps: the task's time limit in control steps.
        clip_limits: the keys of `CLIP_LIMITS` that the task sets.
    """

    def __init__(
        self,
        metrics: MetricsObserver,
        measurement: MeasurementObserver | None,
        max_episode_steps: int,
        clip_limits: Collection[str] = (),
    ) -> None:
        super().__init__()
        self._metrics, self._measurement = metrics, measurement
        self._max_episode_steps = max_episode_steps
        self.clip_limits = clip_limits
        self.config: Mapping[str, Any] = {}
        self.implausible = ""
        self.measurements: list[Measurement] = []
        self._window: deque[EpochMetrics] = deque()
        self._first_frame: int | None = None
        self._warned_s: dict[str, float] = {}

    def after_init(self, algo: Any) -> None:
        """Store the agent."""
        self._algo, self.config = algo, algo.config

    def after_print_stats(self, frame: int, epoch_num: int, total_time: float) -> None:
        """Add the new values, and log a warning if there is one."""
        if self._metrics.latest is None:
            return
        observer = self._measurement
        if observer is not None and observer.last is not None and observer.last_frame is not None:
            result, measured_at = observer.last.imitation, observer.last_frame
            is_new = not self.measurements or self.measurements[-1].frame != measured_at
            if is_new and result is not None:
                self.implausible = observer.implausible
                values = (result.pose_error_m, result.no_fall_share, observer.clip_spread_m)
                shown = (result.motion_shown, result.tempo, result.fall_moment)
                self.measurements.append(Measurement(measured_at, *values, *shown))
        warning = self.next_warning(self._metrics.latest, time.monotonic())
        if warning is not None:
            log.warning("%s", warning)
            self._algo.writer.add_text("advice", warning, frame)

    def next_warning(self, epoch: EpochMetrics, now_s: float) -> str | None:
        """Return the warning to log after an epoch, or None if there is none.

        The same warning is repeated after `REPEAT_S` seconds; `now_s` is the time of any clock.
        """
        window = self._window
        window.append(epoch)
        if self._first_frame is None:
            self._first_frame = epoch.frame

        def is_long_since(other: EpochMetrics) -> bool:
            is_old = epoch.frame - other.frame >= WINDOW_FRAMES
            return is_old and epoch.epoch - other.epoch >= WINDOW_EPOCHS

        while len(window) > 1 and is_long_since(window[1]):
            window.popleft()
        if epoch.epoch % CHECK_EPOCHS != 0 or not is_long_since(window[0]):
            return None
        self._steps = _median(each.episode_steps for each in window)
        self._early_end_rate = _median(each.early_end_rate for each in window)
        self._measured = [one for one in self.measurements if math.isfinite(one.pose_error_m)]
        # Only the first fault is reported, because the later ones may be its consequences.
        for rule in (
            self._no_reward,
            self._standing_still,
            self._gets_worse,
            self._in_a_hurry,
            self._falls,
        ):
            warning = rule()
            if warning is not None:
                if now_s - self._warned_s.get(rule.__name__, -math.inf) < REPEAT_S:
                    return None
                self._warned_s[rule.__name__] = now_s
                return warning
        return None

    # --- the rules ---------------------------------------------------------------------------

    def _no_reward(self) -> str | None:
        # A hierarchy has no discriminator of its own, and no `disc_coef`.
        has_goal = self.config.get("task_reward_w", 0.0) != 0 and "disc_coef" in self.config
        if self.config.get("disc_reward_w", 1.0) == 0 or (self._policy_learns() and not has_goal):
            return None
        scale = float(self.config.get("disc_reward_scale", 1.0)) or 1.0
        reward = _median(epoch.style_reward for epoch in self._window)
        is_far = bool(self._measured) and self._measured[-1].pose_error_m > BAD_POSE_ERROR_M
        is_bad = has_goal or is_far or self._early_end_rate > MOSTLY_FALLS
        if not reward / scale < NO_REWARD or not is_bad:
            return None
        if has_goal:
            return (
                f"the style reward has vanished: for {_millions(WINDOW_FRAMES)} frames it was"
                f" {reward:.3f} a step, so the policy earns the task's reward in a way that no clip"
                " shows; start again from clips that show how the goal is reached, with"
                " ++train.params.config.amp_obs_steps=2 and"
                f" {self._turn('disc_reward_w', 2.0)} (train=HumanoidHeadingAMP is an example)"
            )
        rate = "disc_learning_rate" if self.config.get("disc_learning_rate") else "learning_rate"
        return (
            f"the style reward has vanished: for {_millions(WINDOW_FRAMES)} frames it was"
            f" {reward:.3f} a step and episodes did not get longer ({self._steps:.0f} steps), so"
            " the policy has nothing to learn from; start again with"
            f" {self._turn('disc_grad_penalty', 2.0)}, {self._turn(rate, 0.5)} or"
            f" {self._turn('amp_minibatch_size', 0.5)}"
        )

    def _standing_still(self) -> str | None:
        # A policy whose episodes nearly all end early does not stand.
        if not self._last_are(lambda one: one.is_still) or self._early_end_rate > NEARLY_ALL_FALL:
            return None
        cut = "cut the parts without motion out of the clips"
        if missing := self._missing_limits("clipDeviation", "clipTravel"):
            cut = (
                f"set {missing}, which ends episodes that fall behind their clip"
                f" (with one clip in task.env.motion_file); or {cut}"
            )
        return (
            f"the policy stands still: in the last {LAST_MEASUREMENTS} measurements its episodes"
            f" seldom ended in a fall, but they show {self._measured[-1].motion_shown:.0%} of the"
            f" clips' motion; {cut}{self._clips_are_odd()}"
        )

    def _in_a_hurry(self) -> str | None:
        if not self._last_are(lambda one: one.is_hasty):
            return None
        tempo = self._measured[-1].tempo
        proposed = self._missing_limits("clipDeviation", "clipTempo")
        proposed = proposed or "a smaller task.env.clipDeviation, such as 0.2"
        seen = "its tempo was above the clip's" if tempo > 1.0 else "its steps fitted no clip"
        return (
            f"the policy is in a hurry: in the last {LAST_MEASUREMENTS} measurements {seen}, now"
            f" {tempo:.2f} times the clip's, as with quick, short steps; set {proposed}, which ends"
            " these episodes in training (with one clip in task.env.motion_file)"
        )

    def _gets_worse(self) -> str | None:
        earlier = self._measured[:-LAST_MEASUREMENTS]
        good = [one for one in earlier if one.stays_up and not one.motion_shown < STANDING_SHOWN]
        best = min(good, key=lambda one: one.pose_error_m, default=None)
        if best is None:
            return None
        least_m = min(one.pose_error_m for one in self._measured[-LAST_MEASUREMENTS:])
        if least_m < WORSE_POSE_ERROR * best.pose_error_m:
            return None
        rate = self._turn("learning_rate", 0.5)
        if self.config.get("lr_schedule") == "constant":
            rate = f"train.params.config.lr_schedule=linear, or {rate}"
        return (
            f"the policy gets worse: its pose error was {best.pose_error_m:.3f} m after"
            f" {_millions(best.frame)} frames, and at least {least_m:.3f} m in the last"
            f" {LAST_MEASUREMENTS} measurements; go on from a checkpoint at that time with smaller"
            f" steps: {rate}"
        )

    def _falls(self) -> str | None:
        frames = self._window[-1].frame - (self._first_frame or 0)
        if frames < FALL_FRAMES or self._policy_learns():
            return None
        last = self._measured[-LAST_MEASUREMENTS:]
        # A good policy may fall because of the exploration noise.
        stays_up = bool(last) and all(one.stays_up for one in last)
        is_short = self._steps < SHORT_SHARE * self._max_episode_steps
        if stays_up or not (is_short and self._early_end_rate > NEARLY_ALL_FALL):
            return None
        off_clip = _median(epoch.off_clip_rate for epoch in self._window)
        end = f"in a fall or off the clip ({off_clip:.0%})" if off_clip > 0.0 else "in a fall"
        where = ""
        if last and (moment := last[-1].fall_moment) is not None:
            where = (
                f", {moment.share:.0%} of the falls from {moment.time_s:.1f} s of clip"
                f" {moment.clip + 1} on"
            )
        return (
            f"after {_millions(frames)} frames of this run episodes still end {end} after"
            f" {self._steps:.0f} of {self._max_episode_steps} steps{where}; try"
            " task.env.adaptiveStarts=0.5, which practises where the policy falls, and make sure"
            " that task.env.contactBodies has every body with which the clip touches the ground"
            f" (null finds them){self._clips_are_odd()}"
        )

    # --- parts of rules --------------------------------------------------------------------

    def _last_are(self, is_faulty: Callable[[Measurement], bool]) -> bool:
        """Return whether each of the last measurements shows a faulty policy that seldom falls."""
        faulty = [one for one in self._measured[-LAST_MEASUREMENTS:] if is_faulty(one)]
        return sum(one.stays_up for one in faulty) == LAST_MEASUREMENTS

    def _policy_learns(self) -> bool:
        """Return whether episodes get longer or the measured pose error gets lower."""
        lengths = [epoch.episode_steps for epoch in self._window]
        third = max(1, len(lengths) // 3)
        if _median(lengths[-third:]) >= MIN_GROWTH * _median(lengths[:third]):
            return True
        start = self._window[0].frame
        before = [one.pose_error_m for one in self._measured if one.frame <= start]
        after = [one.pose_error_m for one in self._measured if one.frame > start]
        if not before or not after:
            return bool(before or after)  # nothing to compare with yet
        return min(after) < (1.0 - MIN_IMPROVEMENT) * min(before)

    def _missing_limits(self, *keys: str) -> str:
        """Return settings for the keys of `CLIP_LIMITS` whose value in the task is 0."""
        missing = [key for key in keys if key not in self.clip_limits]
        return " and ".join(f"task.env.{key}={CLIP_LIMITS[key]:g}" for key in missing)

    def _clips_are_odd(self) -> str:
        """Return a clause about clip motions that no policy can imitate; '' if there are none."""
        return f"; no policy can imitate the clips: {self.implausible}" if self.implausible else ""

    def _turn(self, key: str, factor: float) -> str:
        """Return `train.params.config.<key>=<factor * value> (now <value>)`."""
        value = self.config.get(key)
        name = f"train.params.config.{key}"
        if not isinstance(value, (int, float)) or value == 0:
            return name
        return f"{name}={factor * value:g} (now {value:g})"


def _median(values: Iterable[float | None]) -> float:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else math.nan


def _millions(frames: float) -> str:
    return f"{frames / 1e6:.1f} M"
