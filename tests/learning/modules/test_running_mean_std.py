from __future__ import annotations

import pytest
import torch
from rl_games.algos_torch import running_mean_std as rl_games

from isaacgymenvs_lite.learning.modules.running_mean_std import RunningMeanStd, replace_normalizers


def test_statistics_and_rows_are_those_of_rl_games():
    own, other = RunningMeanStd((5,)), rl_games.RunningMeanStd((5,))
    generator = torch.Generator().manual_seed(0)
    for scale in (1.0, 30.0, 0.01):
        rows = scale * torch.randn(200, 5, generator=generator) + torch.arange(5.0)
        # float32 sums over 200 rows
        torch.testing.assert_close(own(rows), other(rows), rtol=1e-4, atol=1e-5)
    for name, value in other.state_dict().items():
        torch.testing.assert_close(own.state_dict()[name], value, rtol=1e-5, atol=1e-7)
        assert own.state_dict()[name].dtype == torch.float64
    own.eval(), other.eval()
    before = own.count.item()
    torch.testing.assert_close(own(rows), other(rows), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(
        own(rows, denorm=True), other(rows, denorm=True), rtol=1e-5, atol=1e-4
    )
    assert own.count.item() == before


def test_a_large_mean_does_not_swallow_the_spread():
    rows = torch.tensor([[10000.0], [10001.0], [10002.0], [10003.0]])
    own = RunningMeanStd((1,))
    own(rows)
    # count 1 with mean 0 and variance 1, then four rows with mean 10001.5 and variance 1.25
    expected = (1.0 * 1 + 1.25 * 4 + 10001.5**2 * 1 * 4 / 5) / 5
    assert own.running_var.item() == pytest.approx(expected, rel=1e-6)


def test_a_model_keeps_its_statistics_and_its_mode():
    model = torch.nn.Module()
    model.running_mean_std = torch.jit.script(rl_games.RunningMeanStd((3,)))
    model.value_mean_std = torch.jit.script(rl_games.RunningMeanStd((1,))).eval()
    model.running_mean_std(torch.randn(50, 3))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    replace_normalizers(model)
    assert isinstance(model.running_mean_std, RunningMeanStd)
    assert isinstance(model.value_mean_std, RunningMeanStd)
    assert model.running_mean_std.training
    assert not model.value_mean_std.training
    after = model.state_dict()
    assert after.keys() == before.keys()
    assert all(torch.equal(after[name], value) for name, value in before.items())


def test_a_model_without_normalisers_stays_as_it_is():
    model = torch.nn.Linear(2, 2)
    replace_normalizers(model)
    assert [name for name, _ in model.named_modules()] == [""]


def test_a_memory_lets_old_rows_fade():
    forgetful, faithful = RunningMeanStd((1,), memory=100), RunningMeanStd((1,))
    for normalizer in (forgetful, faithful):
        normalizer(torch.full((100, 1), 50.0))
    mean = faithful.running_mean.item()
    assert forgetful.running_mean.item() == mean
    for _ in range(20):
        forgetful(torch.zeros(50, 1))
        mean *= 100 / 150  # 100 remembered rows against 50 new ones
        assert forgetful.count.item() == 100.0
    assert forgetful.running_mean.item() == pytest.approx(mean, rel=1e-6)
    assert forgetful.running_var.item() < 1.0 < faithful.running_var.item() * 10
