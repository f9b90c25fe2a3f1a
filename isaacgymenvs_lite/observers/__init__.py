"""What a training run shows: progress, scalars, the imitation metric, advice when it goes wrong.

Observers are rl_games' `AlgoObserver`s; `MultiObserver` makes one of several.
"""

from isaacgymenvs_lite.observers.advice_observer import AdviceObserver
from isaacgymenvs_lite.observers.figures import EpochFigures, FiguresObserver
from isaacgymenvs_lite.observers.imitation import ImitationObserver
from isaacgymenvs_lite.observers.multi import MultiObserver
from isaacgymenvs_lite.observers.progress import ProgressObserver
from isaacgymenvs_lite.observers.task_scalars import TaskScalarsObserver

__all__ = [
    "AdviceObserver",
    "EpochFigures",
    "FiguresObserver",
    "ImitationObserver",
    "MultiObserver",
    "ProgressObserver",
    "TaskScalarsObserver",
]
