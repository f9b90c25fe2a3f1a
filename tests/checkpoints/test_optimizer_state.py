from __future__ import annotations

import pytest
import torch
from torch import nn

from isaacgymenvs_lite.checkpoints.files import fit_optimizer_state
from isaacgymenvs_lite.errors import CheckpointError


def stepped(model: nn.Module, groups) -> torch.optim.Adam:
    optimizer = torch.optim.Adam(groups, lr=0.5)
    for number, parameter in enumerate(model.parameters()):
        parameter.grad = torch.full_like(parameter, float(number + 1))
    optimizer.step()
    return optimizer


def model() -> nn.Module:
    return nn.ModuleDict({"a": nn.Linear(2, 3), "b": nn.Linear(3, 4), "c": nn.Linear(4, 5)})


def test_the_moments_of_one_group_find_their_parameters_in_two():
    old, new = model(), model()
    state = stepped(old, old.parameters()).state_dict()
    # the second layer apart: the order of the parameters is another one
    others = [*new["a"].parameters(), *new["c"].parameters()]
    optimizer = torch.optim.Adam([{"params": others}, {"params": new["b"].parameters(), "lr": 0.1}])
    optimizer.load_state_dict(fit_optimizer_state(state, optimizer, new))
    for number, parameter in enumerate(new.parameters()):
        moment = optimizer.state[parameter]["exp_avg"]
        assert moment.shape == parameter.shape
        assert moment.unique().tolist() == pytest.approx([0.1 * (number + 1)])
    assert [group["lr"] for group in optimizer.param_groups] == [0.5, 0.1]


def test_a_state_of_several_groups_does_not_fit_into_one():
    net = model()
    state = stepped(net, [{"params": layer.parameters()} for layer in net.values()]).state_dict()
    with pytest.raises(CheckpointError, match=r"3 groups of parameters, expected 1.*disc_learning"):
        fit_optimizer_state(state, torch.optim.Adam(net.parameters()), net)
