"""Files of policies against the policies themselves."""

from __future__ import annotations

import io
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
from tests.export.conftest import KINDS

ROWS = 1000
CFG = OmegaConf.create({"task": {"name": "Task"}, "train": {"params": {"algo": {"name": "some"}}}})


def write(player: Any, name: str, folder: Path) -> tuple[PolicyGraph, Path]:
    graph, kind = make_exportable_policy(player), FORMATS[name]
    metadata = describe(CFG, player, graph, {"frame": 7})
    path = folder / f"policy{kind.suffix}"
    path.write_bytes(kind.write(graph, metadata))
    return graph, path


@pytest.fixture(params=sorted(FORMATS))
def format_name(request: pytest.FixtureRequest) -> str:
    for package in FORMATS[request.param].packages:
        pytest.importorskip(package)
    return request.param


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_agrees_with_torch_on_a_thousand_observations(
    kind, format_name, make_player, tmp_path
) -> None:
    graph, path = write(make_player(kind), format_name, tmp_path)
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
        for name, expected in zip(outputs, found, strict=True):
            assert np.abs(outputs[name] - expected.numpy()).max() < 1e-5
        assert rows == 1 or outputs["action"].std() > 0.01


def test_a_file_holds_the_actor_only(format_name, make_player, tmp_path) -> None:
    player = make_player("amp")
    _, path = write(player, format_name, tmp_path)
    whole = io.BytesIO()
    torch.save(player.model.state_dict(), whole)
    actor = 4 * (105 * 16 + 16 * 8 + 8 * 28)
    metadata = len(json.dumps(load_policy(path).metadata))
    assert actor < path.stat().st_size - metadata < actor + 25_000


def test_onnx_needs_no_further_file_and_is_valid(make_player, tmp_path) -> None:
    onnx = pytest.importorskip("onnx")
    _, path = write(make_player("lstm"), "onnx", tmp_path)
    onnx.checker.check_model(str(path), full_check=True)
    assert list(tmp_path.glob("policy*")) == [path]
    model = onnx.load(str(path))
    shapes = {
        value.name: [dim.dim_param or dim.dim_value for dim in value.type.tensor_type.shape.dim]
        for value in (*model.graph.input, *model.graph.output)
    }
    assert shapes == {
        "obs": ["batch", 4],
        "hidden": [1, "batch", 8],
        "cell": [1, "batch", 8],
        "action": ["batch", 1],
        "hidden_out": [1, "batch", 8],
        "cell_out": [1, "batch", 8],
    }


def test_metadata_is_read_back(format_name, make_player, tmp_path) -> None:
    metadata = load_policy(write(make_player("hrl"), format_name, tmp_path)[1]).metadata
    assert metadata["project"] == "isaacgymenvs_lite"
    assert metadata["task"] == "Task"
    assert metadata["frames"] == 7
    assert metadata["llc_steps"] == 3
    assert [port["name"] for port in metadata["inputs"]] == ["obs", "latent", "decide"]
    assert metadata["inputs"][2] == {"name": "decide", "shape": ["batch"], "dtype": "bool"}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("policy.pth", "unknown suffix of an exported policy '.pth'"),
        ("absent.onnx", "absent.onnx: no such file"),
    ],
)
def test_files_that_are_none(name, message, tmp_path) -> None:
    with pytest.raises(ConfigError, match=message):
        load_policy(tmp_path / name)


def test_a_missing_package_names_the_extra(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        MissingPackageError,
        match=r"package onnx, which is not installed.*isaacgymenvs-lite\[export\]",
    ):
        FORMATS["onnx"].check_packages("onnx")
    FORMATS["torchscript"].check_packages("torchscript")
