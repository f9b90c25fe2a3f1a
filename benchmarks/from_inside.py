"""A training whose epochs somebody else decides, so that it can be measured from inside."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from omegaconf import DictConfig

from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.runner import Session


class MeasuredError(Exception):
    """Ends the training: what was to be measured is."""


def train_from_inside(cfg: DictConfig, agent_class: Any, epoch: Callable[[Any], Any]) -> None:
    """Train until `MeasuredError`, or the configuration's end.

    What is printed during a training goes to the log: keep results, and print them afterwards.

    Args:
        cfg: a composed tree.
        agent_class: of the agent that it trains.
        epoch: called with the agent in place of `agent_class.train_epoch`.
    """
    former = agent_class.train_epoch
    agent_class.train_epoch = epoch
    try:
        Session(cfg, check_config(cfg), seed=0).run()
    except MeasuredError:
        pass
    finally:
        agent_class.train_epoch = former
