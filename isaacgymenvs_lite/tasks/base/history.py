"""Histories of control steps, the newest first, and actions that take effect later."""

from __future__ import annotations

import torch
from torch import Tensor

from isaacgymenvs_lite.utils.state import Stateful


class ActionDelay(Stateful):
    """A delay of whole control steps for each of N environments, drawn for each episode.

    Args:
        least: control steps.
        most: control steps, at least `least`.
        num_envs: N.
        num_actions: A.
        device: of the actions.

    Attributes:
        steps: (N,) int64, the delays of the running episodes in control steps.
    """

    def __init__(
        self, least: int, most: int, num_envs: int, num_actions: int, device: torch.device
    ) -> None:
        self._limits = (least, most)
        self.steps = torch.full((num_envs,), least, dtype=torch.int64, device=device)
        # (N, most + 1, A), the newest first
        self._actions = torch.zeros(num_envs, most + 1, num_actions, device=device)
        self._rows = torch.arange(num_envs, device=device)

    def reset(self, env_ids: Tensor) -> None:
        """Draw the delays of new episodes of `env_ids` (n,), before which all actions were zero."""
        least, most = self._limits
        drawn = torch.randint(least, most + 1, (len(env_ids),), device=env_ids.device)
        self.steps.index_copy_(0, env_ids, drawn)
        self._actions.index_fill_(0, env_ids, 0.0)

    def __call__(self, actions: Tensor) -> Tensor:
        """Store the actions (N, A) of a control step, and return those that take effect in it."""
        push_newest(self._actions, actions)
        return self._actions[self._rows, self.steps]


def push_newest(history: Tensor, newest: Tensor) -> None:
    """Put values (N, ...) first into a history (N, H, ...), in place; the oldest ones drop out."""
    for age in range(history.shape[1] - 1, 0, -1):
        history[:, age] = history[:, age - 1]
    history[:, 0] = newest
