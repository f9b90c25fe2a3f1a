"""Converts optimiser states of checkpoints whose parameters are grouped in another way.

A checkpoint of IsaacGymEnvs has one group; an agent with a learning rate for the discriminator
has two. torch numbers the parameters group by group, so that the states have to be renumbered.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from isaacgymenvs_lite.errors import CheckpointError


def fit_optimizer_state(
    state: dict[str, Any], optimizer: torch.optim.Optimizer, model: nn.Module
) -> dict[str, Any]:
    """Return an optimiser's state in the groups of `optimizer`.

    A state with as many groups as the optimiser has is returned as it is.

    Args:
        state: an optimiser's `state_dict`.
        optimizer: made of the model's parameters, in any number of groups.
        model: whose order of parameters a single group has.

    Raises:
        CheckpointError: the state has several groups, and not as many as the optimiser.
    """
    groups = state["param_groups"]
    if len(groups) == len(optimizer.param_groups):
        return state
    if len(groups) != 1:
        raise CheckpointError(
            f"the checkpoint's optimiser has {len(groups)} groups of parameters, expected"
            f" {len(optimizer.param_groups)}: it was trained with"
            " train.params.config.disc_learning_rate; set it (to learning_rate's value for no"
            " difference)"
        )
    place = {id(parameter): i for i, parameter in enumerate(model.parameters())}
    # Number in the optimiser -> number in the single group.
    order = [place[id(p)] for group in optimizer.param_groups for p in group["params"]]
    own = optimizer.state_dict()["param_groups"]
    return {
        "state": {
            new: state["state"][old] for new, old in enumerate(order) if old in state["state"]
        },
        "param_groups": [
            {**groups[0], "params": group["params"], **({} if i == 0 else {"lr": group["lr"]})}
            for i, group in enumerate(own)
        ],
    }
