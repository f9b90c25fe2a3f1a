"""The number that a run returns, by which sweeps compare runs: a pose error or a mean reward."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from isaacgymenvs_lite.errors import SweepError


@dataclass(frozen=True)
class Objective:
    """What a run returns.

    Attributes:
        name: for messages.
        unit: of the number, with a blank before it; '' without one.
        direction: `minimize` or `maximize`, in the words of Hydra's sweepers.
    """

    name: str
    unit: str
    direction: str

    def check_direction(self, direction: str, task: str) -> None:
        """Check that a study optimises this number in the right direction, before a training.

        A study whose jobs pass does not mix metres with rewards.

        Args:
            direction: `hydra.sweeper.direction`; '' outside of a study.
            task: name of the task.

        Raises:
            SweepError: it is the other one.
        """
        if direction and direction != self.direction:
            raise SweepError(
                f"hydra.sweeper.direction={direction}: this run of {task} returns its {self.name};"
                f" set hydra.sweeper.direction={self.direction}"
            )

    def describe(self, value: float) -> str:
        """Return a value for users."""
        return f"{self.name} {value:.4g}{self.unit}"


POSE_ERROR = Objective("best pose error", " m", "minimize")
MEAN_REWARD = Objective("best mean reward", "", "maximize")


def objective_of(config: Mapping[str, Any], has_pose_error: bool) -> Objective:
    """Return what a run is compared by.

    The pose error counts where it is measured and the task's reward does not: `task_reward_w: 0`,
    as AMP has it. Everything else is there for the task's reward: PPO, SAC, a hierarchy on a goal.

    Args:
        config: `train.params.config`.
        has_pose_error: whether the run measures it.
    """
    learns_task = config.get("task_reward_w", 1.0) != 0
    return POSE_ERROR if has_pose_error and not learns_task else MEAN_REWARD
