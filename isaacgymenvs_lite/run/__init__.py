"""What a training run shows: progress, scalars, the imitation metric, advice when it goes wrong.

Observers are rl_games' `AlgoObserver`s; `MultiObserver` makes one of several.
"""

from isaacgymenvs_lite.run.diagnostics_observer import DiagnosticsObserver
from isaacgymenvs_lite.run.imitation import ImitationObserver
from isaacgymenvs_lite.run.metrics import EpochMetrics, MetricsObserver
from isaacgymenvs_lite.run.multi_observer import MultiObserver
from isaacgymenvs_lite.run.progress import ProgressObserver
from isaacgymenvs_lite.run.task_scalars import TaskScalarsObserver

__all__ = [
    "DiagnosticsObserver",
    "EpochMetrics",
    "ImitationObserver",
    "MetricsObserver",
    "MultiObserver",
    "ProgressObserver",
    "TaskScalarsObserver",
]
