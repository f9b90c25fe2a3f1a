"""What an action of +-1 means to the actuators, for those who drive them without the task."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class ActionScaling(NamedTuple):
    """The target of actuator i is `offset[i] + scale[i] * action[i]`.

    Attributes:
        unit: of the targets: `rad` of position drives, `Nm` or `N` of motors.
        offset: (A,).
        scale: (A,).
    """

    unit: str
    offset: Tensor
    scale: Tensor
