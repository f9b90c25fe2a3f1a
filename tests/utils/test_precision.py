from __future__ import annotations

import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.utils import precision
from isaacgymenvs_lite.utils.precision import (
    measure_bfloat16_speedup,
    resolve_mixed_precision,
)


def test_a_plain_choice_is_taken(monkeypatch):
    for device in ["cpu", "cuda:0"]:
        for value in [True, False]:
            monkeypatch.setattr(
                precision, "measure_bfloat16_speedup", lambda: pytest.fail("measured")
            )
            monkeypatch.setattr(precision, "supports_bfloat16", lambda: True)
            assert resolve_mixed_precision(value, device) is value


def test_a_cpu_without_bfloat16_uses_float32(monkeypatch, caplog):
    monkeypatch.setattr(precision, "supports_bfloat16", lambda: False)
    with caplog.at_level("INFO"):
        assert resolve_mixed_precision(True, "cpu") is False
    assert "no instructions for bfloat16; using float32" in caplog.text
    assert resolve_mixed_precision(True, "cuda:0") is True


def test_linear_layers_compute_in_bfloat16_where_it_is_supported():
    layer, rows = torch.nn.Linear(4, 4), torch.rand(2, 4)
    with torch.autocast("cpu", torch.bfloat16):
        assert layer(rows).dtype == torch.bfloat16
    if precision.supports_bfloat16():
        memory = torch.nn.LSTM(4, 4)
        with torch.autocast("cpu", torch.bfloat16):
            assert torch.isfinite(memory(rows)[0]).all()


@pytest.mark.parametrize(("speedup", "chosen"), [(0.6, False), (1.05, False), (4.0, True)])
def test_auto_takes_what_is_clearly_faster(speedup, chosen, monkeypatch, caplog):
    monkeypatch.setattr(precision, "measure_bfloat16_speedup", lambda: speedup)
    with caplog.at_level("INFO"):
        assert resolve_mixed_precision("auto", "cpu") is chosen
    assert ("bfloat16" if chosen else "float32") in caplog.text.split("using ")[1]


def test_another_value_is_refused():
    for value in ["bf16", 1, None, "True"]:
        with pytest.raises(ConfigError, match=r"mixed_precision=.*expected True, False or auto"):
            resolve_mixed_precision(value, "cpu")


def test_the_measurement_leaves_the_random_numbers_alone():
    torch.manual_seed(3)
    before = torch.get_rng_state()
    assert measure_bfloat16_speedup() > 0.0
    assert torch.equal(torch.get_rng_state(), before)
