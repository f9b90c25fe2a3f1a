"""The state at which the specification gives numbers."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch


@pytest.fixture
def case() -> SimpleNamespace:
    """Rows (1, ...): root position before and after a step of 1/30 s, rotation, whole state."""
    rot = torch.tensor([[0.1, -0.2, 0.3, 0.9]])
    rot = rot / rot.norm()
    pos = torch.tensor([[1.0, 2.0, 0.9]])
    return SimpleNamespace(
        pos=pos,
        prev_pos=torch.tensor([[0.97, 1.99, 0.9]]),
        rot=rot,
        dt=1.0 / 30.0,
        root_states=torch.cat((pos, rot, torch.zeros(1, 6)), dim=-1),
    )
