"""Compares running episodes with their clips: distance, travel and tempo.

A policy that stands instead of leaping never falls, so falls alone do not end its episodes early.
DeepMimic (Peng et al. 2018, arXiv 1804.02717) prescribes a phase for every episode. Trackers such
as PHC (Luo et al. 2023, arXiv 2305.06456) end an episode that is too far from its reference. An AMP
episode has its own tempo, so its phase is searched for. Each control step advances the phase by at
least half a step, to the nearest pose a little later.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import CharacterState, HumanoidAMPConfig
from isaacgymenvs_lite.tasks.amp.reference_motions import ReferenceMotions
from isaacgymenvs_lite.tasks.base.humanoid_observations import heading_cos_sin
from isaacgymenvs_lite.utils.state import Stateful

PHASES_PER_STEP = 2
COMPARED_S = 1.0
"""Duration over which travel and tempo are compared."""
_ADVANCES = range(1, 9)  # phases per control step: from half the clip's tempo to four times
# A tempo that differs by one phase costs this share of `limit_m`. The phase therefore keeps the
# clip's tempo among similar poses.
_OFF_TEMPO = 0.02
# The limits narrow while the mean episode grows from the first to the second of these durations. A
# policy first learns to stay up, and its first kicks and steps are slow. Steps that are too quick
# are never allowed, because training does not unlearn them.
_EASED_S = (COMPARED_S, 3.0 * COMPARED_S)
_SLOWEST_TEMPO = 0.5
_AVERAGED_EPISODES = 4  # of each environment, in the mean duration
_NONE = -1
_TINY = 1e-9


def distance_up_to_heading_m(points: Tensor, others: Tensor) -> Tensor:
    """Return the mean distance (...) m of points (..., P, 3) from others, whatever their heading.

    The points are first turned about z to minimise the squared distances. Unlike a heading, this
    turn is defined upside down, too.
    """
    x, y, z = points.unbind(dim=-1)
    other_x, other_y, other_z = others.unbind(dim=-1)
    dots, crosses = x * other_x + y * other_y, x * other_y - y * other_x
    dot, cross = dots.sum(dim=-1, keepdim=True), crosses.sum(dim=-1, keepdim=True)
    size = torch.hypot(dot, cross).clamp(min=_TINY)
    turned = (dot * dots + cross * crosses) / size  # scalar products after the turn
    squares = x * x + y * y + other_x * other_x + other_y * other_y + (z - other_z) ** 2
    return (squares - 2.0 * turned).clamp(min=0.0).sqrt().mean(dim=-1)


def travel_through(root_states: Tensor, num_phases: int, repeats: bool) -> Tensor:
    """Return the travel of a clip's root in the `num_phases` phases before each phase.

    A clip that repeats continues from its end to its start, straight on. The travel to the first
    phases of any other clip is unknown.

    Args:
        root_states: (S, >= 7) position (m, world) and rotation (xyzw) of the clip's phases.
        num_phases: duration of the travel, which may exceed the clip.
        repeats: True: the clip repeats.

    Returns:
        (S, 2) m, in the heading frame of the phase where the travel ends; nan where it is unknown.
    """
    # Complex numbers represent the plane, where a product turns.
    places = torch.complex(root_states[:, 0], root_states[:, 1])
    headings = torch.complex(*heading_cos_sin(*root_states[:, 3:7].unbind(-1)))
    moves = (places[1:] - places[:-1]) * headings[:-1].conj()
    turns = headings[1:] * headings[:-1].conj()
    # The step from the last phase to the first averages its neighbours, straight on.
    start = torch.ones_like(headings[:1])
    moves = torch.cat((moves, start * (moves[-1:].sum() + moves[:1].sum()) / 2.0))
    turns = torch.cat((turns, start))
    num_own = len(places)
    steps = torch.arange(-num_phases, num_own - 1, device=places.device) % num_own
    headings = torch.cat((start, turns[steps])).cumprod(dim=0)
    places = torch.cat((torch.zeros_like(start), moves[steps] * headings[:-1])).cumsum(dim=0)
    travel = (places[num_phases:] - places[:num_own]) * headings[num_phases:].conj()
    travel_m = torch.view_as_real(travel)
    if not repeats:
        travel_m[:num_phases] = torch.nan
    return travel_m


def points_of(state: CharacterState) -> Tensor:
    """Return root and key bodies (n, 1 + K, 3) m, relative to the root's ground point."""
    root_pos = state[0][:, None, :3]
    return torch.cat((root_pos, state[3]), dim=1) - root_pos * root_pos.new_tensor([1, 1, 0])


class ClipPhases(Stateful):
    """Tracks the clip and the phase of each environment.

    A clip repeats if its end is near its start. Other clips are not compared beyond their end. A
    character that rests in a pose of a walk is near the clip, but travels less. A character that
    takes steps of half the length, twice as many, is near the clip and travels as far. Therefore
    travel and tempo can be compared, too.

    Args:
        clips: points (S, P, 3) m of the body for each clip, relative to the root's ground point,
            `PHASES_PER_STEP` times per control step from time 0 on.
        num_envs: N.
        dt_s: duration of a control step.
        limit_m: largest distance while episodes are short, see `current_limit_m`. A clip repeats if
            its end is closer to its start than this.
        root_states: (S, >= 7) for each clip at the same times: position (m, world) and rotation
            (xyzw).
        travel_share: how much less than the clip the root may travel in `COMPARED_S`, as a share,
            but at least `limit_m`; 0: no limit.
        tempo_share: how much faster or slower than the clip an episode may be, as a share; 0: no
            limit. Short episodes may be slower, see `min_tempo`.
        final_limit_m: largest distance once episodes are long; None: `limit_m`.
    """

    stored = (
        *("_clip", "_phase", "is_over", "_trail", "_passed", "_num_followed"),
        *("_mean_steps", "_longest_mean", "_eased"),
    )

    def __init__(
        self,
        clips: Sequence[Tensor],
        num_envs: int,
        dt_s: float,
        limit_m: float,
        root_states: Sequence[Tensor] = (),
        travel_share: float = 0.0,
        tempo_share: float = 0.0,
        final_limit_m: float | None = None,
    ) -> None:
        device = clips[0].device
        self._limit_m = limit_m
        self._final_limit_m = limit_m if final_limit_m is None else final_limit_m
        self._points = torch.cat(list(clips))
        self._lengths = torch.tensor([len(clip) for clip in clips], device=device)
        self._firsts = self._lengths.cumsum(0) - self._lengths
        ends_m = torch.stack([distance_up_to_heading_m(clip[-1], clip[0]) for clip in clips])
        self.repeats = ends_m < limit_m
        self._advances = torch.tensor(_ADVANCES, device=device)
        self._costs_m = _OFF_TEMPO * limit_m * (self._advances - PHASES_PER_STEP).abs()
        self._phases_per_s = PHASES_PER_STEP / dt_s
        self._clip = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self._phase = torch.full((num_envs,), _NONE, device=device)
        self.is_over = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._travel_share = travel_share
        steps = round(COMPARED_S / dt_s)
        self._travels: Tensor | None = None
        if travel_share > 0.0:
            travels = [
                travel_through(states, PHASES_PER_STEP * steps, repeats)
                for states, repeats in zip(root_states, self.repeats.tolist(), strict=True)
            ]
            self._travels = torch.cat(travels)
        # Root positions (T + 1, N, 2) m and phase advances (T, N) in the last COMPARED_S.
        num_places = 0 if self._travels is None else steps + 1
        self._trail = torch.zeros(num_places, num_envs, 2, device=device)
        self._passed = self._clip.new_zeros(steps if tempo_share > 0.0 else 0, num_envs)
        self._max_tempo = 1.0 + tempo_share
        # Episodes that start anywhere in a clip and end with it last half of it on average.
        half_s = 0.5 * max(len(clip) for clip in clips) * dt_s / PHASES_PER_STEP
        share = 1.0 if self.repeats.any() else min(1.0, half_s / _EASED_S[-1])
        first, last = (round(share * time_s / dt_s) for time_s in _EASED_S)
        self._eased_steps = first, max(first + 1, last)
        self._num_followed = torch.zeros(num_envs, dtype=torch.int64, device=device)
        # The mean duration of ended episodes, and its maximum so far.
        self._mean_steps = torch.zeros((), device=device)
        self._longest_mean = torch.zeros((), device=device)
        # 1 selects the wide limits, 0 the narrow limits. The value never rises.
        self._eased = 1.0

    @classmethod
    def of_motions(
        cls,
        motions: ReferenceMotions,
        num_envs: int,
        control_dt_s: float,
        standing_m: float,
        config: HumanoidAMPConfig,
    ) -> ClipPhases:
        """Return the phases of a task's episodes and clips.

        `standing_m` is the root height of a standing character. The limits in `config` are shares
        of it.
        """
        clips, root_states = [], []
        for motion_id in range(motions.lib.num_motions()):
            length_s = float(motions.lib.get_motion_length([motion_id]))
            device = motions.lib.device
            times_s = torch.arange(0.0, length_s, control_dt_s / PHASES_PER_STEP, device=device)
            ids = torch.full((len(times_s),), motion_id, device=device)
            state = motions.states(ids, times_s, ids.new_zeros(1))
            clips.append(points_of(state))
            root_states.append(state[0])
        limit_m = config.clip_deviation * standing_m
        final_limit_m = config.clip_deviation_final * standing_m or limit_m
        return cls(
            clips,
            num_envs,
            control_dt_s,
            limit_m,
            root_states,
            config.clip_travel,
            config.clip_tempo,
            min(limit_m, final_limit_m),
        )

    def start(self, env_ids: Tensor, clips: Tensor, times_s: Tensor) -> None:
        """Track environments (n,) in clips (n,) from times (n,) s on."""
        self._clip[env_ids] = clips
        self._phase[env_ids] = (times_s * self._phases_per_s).round().long()
        self.is_over[env_ids] = False
        steps = self._num_followed[env_ids]
        ended = steps[steps > 0].float()
        if len(ended) > 0:
            weight = min(1.0, len(ended) / (_AVERAGED_EPISODES * len(self._phase)))
            self._mean_steps.lerp_(ended.mean(), weight)
            torch.maximum(self._longest_mean, self._mean_steps, out=self._longest_mean)
            first, last = self._eased_steps
            self._eased = min(1.0, max(0.0, (last - self._longest_mean.item()) / (last - first)))
        self._num_followed[env_ids] = 0

    def stop(self, env_ids: Tensor) -> None:
        """Stop tracking environments (n,)."""
        self._phase[env_ids] = _NONE

    def follows_any(self) -> bool:
        """Return whether an environment is tracked."""
        return bool((self._phase != _NONE).any())

    @torch.inference_mode()
    def are_off(self, state: CharacterState) -> Tensor:
        """Advance all phases by a control step; return (N,) bool: the character left its clip."""
        is_far = self.advance(points_of(state)) > self.current_limit_m()
        is_behind = self.lags_behind(state[0][:, :3], state[0][:, 3:7])
        return is_far | is_behind | self.is_off_tempo()

    def advance(self, points: Tensor) -> Tensor:
        """Advance all phases; return the distances (N,) m of points (N, P, 3) m from the clips.

        The distance is 0 where no clip is tracked.
        """
        lengths = self._lengths[self._clip].unsqueeze(1)
        phases = self._phase.unsqueeze(1) + self._advances
        phases = torch.where(self.repeats[self._clip].unsqueeze(1), phases % lengths, phases)
        rows = self._firsts[self._clip].unsqueeze(1) + phases.clamp(max=lengths - 1)
        away_m = distance_up_to_heading_m(points.unsqueeze(1), self._points[rows])
        nearest = (away_m + self._costs_m).argmin(dim=1, keepdim=True)
        self._num_followed += self._phase != _NONE
        if len(self._passed) > 0:
            passed = self._advances[nearest.squeeze(1)]
            self._passed.copy_(torch.cat((self._passed[1:], passed[None])))
        away_m = away_m.gather(1, nearest).squeeze(1)
        phase = phases.gather(1, nearest).squeeze(1)
        is_followed = self._phase != _NONE
        self.is_over |= is_followed & (phase >= lengths.squeeze(1))
        is_followed &= ~self.is_over
        self._phase.copy_(torch.where(is_followed, phase, _NONE))
        return torch.where(is_followed, away_m, 0.0)

    def lags_behind(self, root_pos: Tensor, root_rot: Tensor) -> Tensor:
        """Return (N,) bool: the root travelled too little in the clip's direction in `COMPARED_S`.

        Call it once per control step, after `advance`. Episodes tracked for less time are not
        compared. Travelling farther is allowed, because a leap that is being learned goes too far
        at first. `root_pos` (N, 3) is in m, world, and `root_rot` (N, 4) is xyzw.
        """
        if self._travels is None:
            return torch.zeros_like(self._phase, dtype=torch.bool)
        self._trail.copy_(torch.cat((self._trail[1:], root_pos[None, :, :2])))
        cos, sin = heading_cos_sin(*root_rot.unbind(-1))
        x, y = (self._trail[-1] - self._trail[0]).unbind(-1)
        travel = torch.stack((cos * x + sin * y, cos * y - sin * x), dim=-1)
        expected = self._travels[self._firsts[self._clip] + self._phase.clamp(min=0)]
        expected_m = expected.norm(dim=-1).clamp(min=_TINY)
        along_m = (travel * expected).sum(dim=-1) / expected_m
        allowed_m = (self._travel_share * expected_m).clamp(min=self._limit_m)
        is_behind = expected_m - along_m > allowed_m
        return is_behind & (self._phase != _NONE) & (self._num_followed >= len(self._trail))

    def is_off_tempo(self) -> Tensor:
        """Return (N,) bool: the episode was too fast or too slow in `COMPARED_S`.

        Call it after `advance`. Episodes tracked for less time are not compared.
        """
        steps = len(self._passed)
        if steps == 0:
            return torch.zeros_like(self._phase, dtype=torch.bool)
        tempo = self._passed.sum(dim=0) / (PHASES_PER_STEP * steps)
        is_off = (tempo > self._max_tempo) | (tempo < self.min_tempo())
        return is_off & (self._phase != _NONE) & (self._num_followed >= steps)

    def min_tempo(self) -> float:
        """Return the current lowest tempo, as a share of the clip's tempo.

        It rises from 0.5 to 1 / (1 + `tempo_share`) as episodes get longer.
        """
        least = 1.0 / self._max_tempo
        return least - max(0.0, least - _SLOWEST_TEMPO) * self._eased

    def current_limit_m(self) -> float:
        """Return the current largest distance, from `limit_m` down to `final_limit_m`."""
        return self._final_limit_m + (self._limit_m - self._final_limit_m) * self._eased
