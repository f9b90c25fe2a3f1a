"""Files of policies against the policies themselves."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from isaacgymenvs_lite.errors import ConfigError, MissingPackageError
from isaacgymenvs_lite.export.exportable_policy import PolicyGraph, make_exportable_policy
from isaacgymenvs_lite.export.formats import FORMATS, load_policy
from isaacgymenvs_lite.export.metadata import describe

ROWS = 1000
CFG = OmegaConf.create({"task": {"name": "Task"}, "train": {"params": {"algo": {"name": "some"}}}})


def write(player: Any, name: str, folder: Path) -> tuple[PolicyGraph, Path]:
    graph, kind = make_exportable_policy(player), FORMATS[name]
    metadata = describe(CFG, player, graph, {"frame": 7})
    path = folder / f"policy{kind.suffix}"
    path.write_bytes(kind.write(graph, metadata))
    return graph, path


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("onnx", "sac"),
        *(pytest.param("onnx", kind, marks=pytest.mark.slow) for kind in ("lstm", "hrl")),
        *(("torchscript", kind) for kind in ("gru", "lstm_apart", "amp", "gen_amp", "hrl")),
    ],
)
def test_a_file_agrees_with_torch_on_a_thousand_observations(
    name, kind, make_player, tmp_path
) -> None:
    for package in FORMATS[name].packages:
        pytest.importorskip(package)
    graph, path = write(make_player(kind), name, tmp_path)
    assert list(tmp_path.glob("policy*")) == [path]
    policy = load_policy(path)
    for rows in (ROWS, 1):
        generator = torch.Generator().manual_seed(rows)
        inputs = [port.sample(rows) for port in graph.inputs]
        inputs[0] = 3.0 * torch.randn(inputs[0].shape, generator=generator)
        found = graph(*inputs)
        found = found if isinstance(found, tuple) else (found,)
        named = {port.name: x.numpy() for port, x in zip(graph.inputs, inputs, strict=True)}
        outputs = policy(named)
        assert list(outputs) == [port.name for port in graph.outputs]
        for output, expected in zip(outputs, found, strict=True):
            assert np.abs(outputs[output] - expected.numpy()).max() < 1e-5
        assert rows == 1 or outputs["action"].std() > 0.01
    metadata = policy.metadata
    assert (metadata["project"], metadata["task"]) == ("isaacgymenvs_lite", "Task")
    assert metadata["frames"] == 7
    if kind == "hrl":
        assert metadata["llc_steps"] == 3
        assert [port["name"] for port in metadata["inputs"]] == ["obs", "latent", "decide"]
        assert metadata["inputs"][2] == {"name": "decide", "shape": ["batch"], "dtype": "bool"}
    if kind == "amp":  # the critic and the discriminator are left out
        actor = 4 * (105 * 16 + 16 * 8 + 8 * 28)
        assert actor < path.stat().st_size - len(json.dumps(metadata)) < actor + 30_000
    if name == "onnx" and kind == "lstm":
        check_onnx(path)


def check_onnx(path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    onnx.checker.check_model(str(path), full_check=True)
    model = onnx.load(str(path))
    shapes = {
        value.name: [dim.dim_param or dim.dim_value for dim in value.type.tensor_type.shape.dim]
        for value in (*model.graph.input, *model.graph.output)
    }
    state = [1, "batch", 8]
    assert shapes == {
        "obs": ["batch", 4],
        "action": ["batch", 1],
        **dict.fromkeys(("hidden", "cell", "hidden_out", "cell_out"), state),
    }


def test_files_that_are_none(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"unknown suffix of an exported policy '\.pth'"):
        load_policy(tmp_path / "policy.pth")
    with pytest.raises(ConfigError, match=r"absent\.onnx: no such file"):
        load_policy(tmp_path / "absent.onnx")


def test_a_missing_package_names_the_extra(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        MissingPackageError,
        match=r"package onnx, which is not installed.*isaacgymenvs-lite\[export\]",
    ):
        FORMATS["onnx"].check_packages("onnx")
    FORMATS["torchscript"].check_packages("torchscript")
