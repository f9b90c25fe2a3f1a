"""Compares running episodes with their clips: pose, distance covered and tempo.

If only falls end episodes early, a policy can stand still instead of imitating a leap. DeepMimic
(Peng et al. 2018, arXiv 1804.02717) prescribes a phase for every episode. Trackers such as PHC (Luo
et al. 2023, arXiv 2305.06456) end an episode whose pose is too far from its reference. The tempo of
an AMP episode is free, so this module searches for the phase. In each control step the phase moves
to the most similar pose of the clip that is between half a control step and four control steps
later.
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
"""Duration (s) over which the distance covered and the tempo are compared."""
_ADVANCES = range(1, 9)  # phases per control step, from 0.5 to 4 times the clip's tempo
# A tempo that differs from the clip's by one phase costs this share of `limit_m`. Among similar
# poses the search therefore prefers the clip's tempo.
_OFF_TEMPO = 0.02
# The limits narrow while the mean episode grows from the first to the second of these durations.
# Wide limits let a new policy learn to stay upright and to make slow first kicks and steps. Steps
# that are too quick are never allowed, because a policy does not unlearn them.
_EASED_S = (COMPARED_S, 3.0 * COMPARED_S)
_SLOWEST_TEMPO = 0.5
_AVERAGED_EPISODES = 4  # episodes per environment in the mean duration
_NONE = -1
_TINY = 1e-9


def distance_up_to_heading_m(points: Tensor, others: Tensor) -> Tensor:
    """Return mean distances (...) m of points (..., P, 3) from others after aligning the headings.

    The points are first rotated about z to minimise the squared distances. This rotation is also
    defined for a body upside down, where the heading is not.
    """
    x, y, z = points.unbind(dim=-1)
    other_x, other_y, other_z = others.unbind(dim=-1)
    dots, crosses = x * other_x + y * other_y, x * other_y - y * other_x
    dot, cross = dots.sum(dim=-1, keepdim=True), crosses.sum(dim=-1, keepdim=True)
    size = torch.hypot(dot, cross).clamp(min=_TINY)
    turned = (dot * dots + cross * crosses) / size  # scalar products after the rotation
    squares = x * x + y * y + other_x * other_x + other_y * other_y + (z - other_z) ** 2
    return (squares - 2.0 * turned).clamp(min=0.0).sqrt().mean(dim=-1)


def travel_through(root_states: Tensor, num_phases: int, repeats: bool) -> Tensor:
    """Return the displacement of a clip's root in the `num_phases` phases before each phase.

    A repeated clip continues in the direction of its last steps. The displacements before the first
    phases of any other clip are unknown.

    Args:
        root_states: (S, >= 7) position (m, world) and rotation (xyzw) of the clip's phases.
        num_phases: duration of the displacement in phases, which may exceed the clip.
        repeats: whether the clip repeats.

    Returns:
        (S, 2) m, in the heading frame of the phase at the end of the displacement. Unknown
        displacements are nan.
    """
    # Complex numbers are points of the plane, and multiplying them rotates.
    places = torch.complex(root_states[:, 0], root_states[:, 1])
    headings = torch.complex(*heading_cos_sin(*root_states[:, 3:7].unbind(-1)))
    moves = (places[1:] - places[:-1]) * headings[:-1].conj()
    turns = headings[1:] * headings[:-1].conj()
    # The step from the last phase to the first phase is the mean of the two neighbouring steps.
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
    """Return root and key bodies (n, 1 + K, 3) m relative to the point below the root at z = 0."""
    root_pos = state[0][:, None, :3]
    return torch.cat((root_pos, state[3]), dim=1) - root_pos * root_pos.new_tensor([1, 1, 0])


class ClipPhases(Stateful):
    """Tracks the clip and the phase of each environment.

    A clip repeats if its end is near its start. Other clips are not compared beyond their end. A
    character that rests in a pose of a walk is near the clip, so the covered distance can be
    compared as well. A character that takes twice as many steps of half the length is near the clip
    and covers the same distance, so the tempo can be compared as well.

    Args:
        clips: for each clip, points (S, P, 3) m of the body relative to the point below the root at
            z = 0. A control step has `PHASES_PER_STEP` phases, and the first phase is at time 0.
        num_envs: N.
        dt_s: duration of a control step.
        limit_m: largest allowed distance from the clip while episodes are short (see
            `current_limit_m`). A clip repeats if its end is closer than `limit_m` to its start.
        root_states: for each clip, the root's world position (m) and rotation (xyzw) at all phases,
            (S, >= 7).
        travel_share: the distance that the root may lag behind the clip in `COMPARED_S`, as a share
            of the clip's distance. A lag of `limit_m` is always allowed. 0 selects no limit.
        tempo_share: allowed difference between the tempos of episode and clip, as a share. 0
            selects no limit. Short episodes may be slower (see `min_tempo`).
        final_limit_m: largest allowed distance once episodes are long. None selects `limit_m`.
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
        # Root positions (T + 1, N, 2) m and phase advances (T, N) of the last COMPARED_S seconds.
        num_places = 0 if self._travels is None else steps + 1
        self._trail = torch.zeros(num_places, num_envs, 2, device=device)
        self._passed = self._clip.new_zeros(steps if tempo_share > 0.0 else 0, num_envs)
        self._max_tempo = 1.0 + tempo_share
        # An episode from a random time to the end of a clip lasts half the clip on average.
        half_s = 0.5 * max(len(clip) for clip in clips) * dt_s / PHASES_PER_STEP
        share = 1.0 if self.repeats.any() else min(1.0, half_s / _EASED_S[-1])
        first, last = (round(share * time_s / dt_s) for time_s in _EASED_S)
        self._eased_steps = first, max(first + 1, last)
        self._num_followed = torch.zeros(num_envs, dtype=torch.int64, device=device)
        # The mean duration of ended episodes, and the maximum of this mean so far.
        self._mean_steps = torch.zeros((), device=device)
        self._longest_mean = torch.zeros((), device=device)
        # 1 selects the wide limits, and 0 selects the narrow limits. The value never rises.
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
        """Make `ClipPhases` from the clips and settings of a task.

        `standing_m` is the root height of a standing character. The limits in `config` are shares
        of this height.
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
        """Start comparing environments (n,) with clips (n,) from times (n,) s on."""
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
        """Stop comparing environments (n,) with clips."""
        self._phase[env_ids] = _NONE

    def follows_any(self) -> bool:
        """Return whether at least one environment is compared with a clip."""
        return bool((self._phase != _NONE).any())

    @torch.inference_mode()
    def are_off(self, state: CharacterState) -> Tensor:
        """Advance phases by a control step, and return which characters (N,) left their clips."""
        is_far = self.advance(points_of(state)) > self.current_limit_m()
        is_behind = self.lags_behind(state[0][:, :3], state[0][:, 3:7])
        return is_far | is_behind | self.is_off_tempo()

    def advance(self, points: Tensor) -> Tensor:
        """Advance all phases, and return distances (N,) m of points (N, P, 3) m from clips.

        The distance is 0 in environments that are not compared with a clip.
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
        """Return which roots (N,) lag behind in the clip's direction in the last `COMPARED_S`.

        Call this method once per control step, after `advance`. Episodes that are younger than
        `COMPARED_S` are ignored. A larger distance is allowed, because first attempts at a leap go
        too far. `root_pos` (N, 3) is in m in world axes, and `root_rot` (N, 4) is xyzw.
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
        """Return which episodes (N,) were too fast or too slow in `COMPARED_S`.

        Call this method after `advance`. Episodes that are younger than `COMPARED_S` are ignored.
        """
        steps = len(self._passed)
        if steps == 0:
            return torch.zeros_like(self._phase, dtype=torch.bool)
        tempo = self._passed.sum(dim=0) / (PHASES_PER_STEP * steps)
        is_off = (tempo > self._max_tempo) | (tempo < self.min_tempo())
        return is_off & (self._phase != _NONE) & (self._num_followed >= steps)

    def min_tempo(self) -> float:
        """Return the current lowest tempo, as a share of the clip's tempo.

        The lowest tempo rises from 0.5 to 1 / (1 + `tempo_share`) as episodes get longer.
        """
        least = 1.0 / self._max_tempo
        return least - max(0.0, least - _SLOWEST_TEMPO) * self._eased

    def current_limit_m(self) -> float:
        """Return the largest allowed distance, which sinks from `limit_m` to `final_limit_m`."""
        return self._final_limit_m + (self._limit_m - self._final_limit_m) * self._eased
