"""Measures whether a skill policy travels and turns as fast as the clip whose latent it holds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from isaacgymenvs_lite.env_interface import ReferenceEnv
from isaacgymenvs_lite.utils.rotations import planar_motion, planar_speed

_STARTS_S = 2.0
"""Characters have this time to begin the motion."""
_MOVING_M_S = 0.3
"""A clip travels or turns from this pace on."""


class Pace(NamedTuple):
    """Mean planar motion: forward and to the left (m/s), and turning to the left (rad/s)."""

    forward_m_s: float
    left_m_s: float
    turn_rad_s: float

    def __str__(self) -> str:
        turn_deg_s = math.degrees(self.turn_rad_s)
        return f"{self.forward_m_s:.2f}, {self.left_m_s:.2f} m/s, {turn_deg_s:.0f} deg/s"

    def distance(self, other: Pace) -> float:
        """Return the difference in m/s; 100 degrees/s count as 1 m/s."""
        return float(planar_speed(torch.tensor([self]) - torch.tensor([other])))


_REST = Pace(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ClipPaces:
    """The paces of clips, and of the characters that hold the clips' latents."""

    clips: dict[str, Pace]
    shown: dict[str, Pace]

    @property
    def moving(self) -> list[str]:
        """The clips that travel or turn."""
        return [n for n, pace in self.clips.items() if pace.distance(_REST) >= _MOVING_M_S]

    @property
    def followed(self) -> list[str]:
        """The moving clips whose pace is missed by at most half."""
        clips, shown = self.clips, self.shown
        return [
            n for n in self.moving if shown[n].distance(clips[n]) <= clips[n].distance(_REST) / 2
        ]

    def __str__(self) -> str:
        """Return a line of text, and a line for each clip."""
        head = f"follows {len(self.followed)} of the {len(self.moving)} clips that travel or turn"
        rows = [f"  {name}: {pace}; shown {self.shown[name]}" for name, pace in self.clips.items()]
        return "\n".join((head, *rows))


class PaceProbe:
    """Measures the paces of characters while a policy is played.

    Args:
        env: the task.
        names: names of all clips of the task.
        clip_of_env: (N,) indices of the clips whose latents the characters hold.
    """

    def __init__(self, env: ReferenceEnv, names: Sequence[str], clip_of_env: Tensor) -> None:
        self._env = env
        self._names = list(names)
        self._clip_of_env = clip_of_env.to(env.device)
        self._first_step = round(_STARTS_S / env.dt)
        self._sum = torch.zeros(len(clip_of_env), 3, device=env.device)
        self._steps = torch.zeros(len(clip_of_env), 1, device=env.device)

    def step(self) -> None:
        """Add the motion of a control step; call this before resets."""
        counts = (self._env.progress_buf > self._first_step).unsqueeze(-1)
        self._sum += counts * planar_motion(self._env.simulation.root_states)
        self._steps += counts

    def result(self) -> ClipPaces | None:
        """Return the paces, or None if no episode was long enough.

        The pace is nan for a clip with only short episodes, so that it is not followed.
        """
        if self._steps.sum() == 0:
            return None
        clips, shown = {}, {}
        for clip in self._clip_of_env.unique().tolist():
            rows = self._clip_of_env == clip
            name = self._names[clip]
            shown[name] = Pace(*(self._sum[rows].sum(0) / self._steps[rows].sum()).tolist())
            clips[name] = self._pace_of_clip(clip)
        return ClipPaces(clips, shown)

    def _pace_of_clip(self, clip: int) -> Pace:
        lib = self._env.motion_lib
        times_s = torch.arange(0.0, float(lib.get_motion_length([clip])), self._env.dt)
        ids = torch.full((len(times_s),), clip)
        pos, rot, _, vel, ang_vel, *_ = lib.get_motion_state(ids, times_s)
        root = torch.cat((pos, rot, vel, ang_vel), dim=-1)
        return Pace(*planar_motion(root).mean(0).tolist())
