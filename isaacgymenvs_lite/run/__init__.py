"""What belongs to one run: its folder, its stop, and the observers that show and log it.

The observers are rl_games' `AlgoObserver`s; `TrainingObservers` are all of them together.
"""

from isaacgymenvs_lite.run.diagnostics import DiagnosticsObserver
from isaacgymenvs_lite.run.measurement import MeasurementObserver
from isaacgymenvs_lite.run.metrics import EpochMetrics, MetricsObserver
from isaacgymenvs_lite.run.observers import MultiObserver, TrainingObservers
from isaacgymenvs_lite.run.progress import ProgressObserver
from isaacgymenvs_lite.run.task_scalars import TaskScalarsObserver

__all__ = [
    "DiagnosticsObserver",
    "EpochMetrics",
    "MeasurementObserver",
    "MetricsObserver",
    "MultiObserver",
    "ProgressObserver",
    "TaskScalarsObserver",
    "TrainingObservers",
]
