"""Writes exported policies in several formats, and runs their files.

policy = load_policy("walk.onnx")
action = policy({"obs": observations})["action"]      # numpy, (n, O) -> (n, A)
"""

from __future__ import annotations

import io
import json
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.export.exportable_policy import PolicyGraph
from isaacgymenvs_lite.utils.optional_packages import require

Arrays = Mapping[str, npt.NDArray[Any]]

# Number of rows of the example inputs; exporters would treat 0 and 1 as constants.
_EXAMPLE_ROWS = 3
_METADATA_FILE = "metadata.json"
_VERBOSE_LOGGERS = ("torch.onnx", "onnxscript", "onnx_ir")


@dataclass(frozen=True)
class ExportedPolicy:
    """An exported policy, which can be called, and its metadata (see `metadata.describe`)."""

    metadata: dict[str, Any]
    run: Callable[[Arrays], dict[str, npt.NDArray[Any]]]

    def __call__(self, inputs: Arrays) -> dict[str, npt.NDArray[Any]]:
        """Return a dictionary from output names to arrays; `inputs` maps input names to arrays."""
        return self.run(inputs)


@dataclass(frozen=True)
class Format:
    """A format's suffix, its packages in addition to torch, its writer and its reader."""

    suffix: str
    packages: tuple[str, ...]
    write: Callable[[PolicyGraph, dict[str, Any]], bytes]
    load: Callable[[Path], ExportedPolicy]

    def check_packages(self, name: str) -> None:
        """Check that the packages are installed.

        Raises:
            MissingPackageError: a package is missing.
        """
        for package in self.packages:
            require(package, f"format={name}", otherwise="choose format=torchscript")


def load_policy(file: str | Path) -> ExportedPolicy:
    """Read an exported policy; the file's suffix determines the format."""
    path = Path(file)
    by_suffix = {kind.suffix: (name, kind) for name, kind in FORMATS.items()}
    if path.suffix not in by_suffix:
        raise ConfigError(unknown("suffix of an exported policy", path.suffix, by_suffix))
    if not path.is_file():
        raise ConfigError(f"{path}: no such file")
    name, kind = by_suffix[path.suffix]
    kind.check_packages(name)
    return kind.load(path)


@contextmanager
def _quiet() -> Iterator[None]:
    """Hide the warnings of torch's exporters about deprecations and missing packages."""
    levels = {logger: logger.level for logger in map(logging.getLogger, _VERBOSE_LOGGERS)}
    for logger in levels:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


def _example(graph: PolicyGraph) -> tuple[torch.Tensor, ...]:
    return tuple(spec.sample(_EXAMPLE_ROWS) for spec in graph.inputs)


# --- ONNX -----------------------------------------------------------------------------------------


def _write_onnx(graph: PolicyGraph, metadata: dict[str, Any]) -> bytes:
    batch = torch.export.Dim("batch")
    with _quiet(), torch.no_grad():
        program = torch.onnx.export(
            graph,
            _example(graph),
            dynamo=True,
            verbose=False,
            input_names=[spec.name for spec in graph.inputs],
            output_names=[spec.name for spec in graph.outputs],
            dynamic_shapes=tuple({spec.batch_axis: batch} for spec in graph.inputs),
        )
    assert program is not None
    # ONNX metadata must be strings; values of other types are stored as JSON.
    program.model.metadata_props.update(
        {
            key: value if isinstance(value, str) else json.dumps(value)
            for key, value in metadata.items()
        }
    )
    return program.model_proto.SerializeToString()


def _load_onnx(file: Path) -> ExportedPolicy:
    import onnxruntime

    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]

    def run(inputs: Arrays) -> dict[str, npt.NDArray[Any]]:
        arrays = (np.asarray(array) for array in session.run(names, dict(inputs)))
        return dict(zip(names, arrays, strict=True))

    stored = session.get_modelmeta().custom_metadata_map
    return ExportedPolicy({key: _from_json(text) for key, text in stored.items()}, run)


def _from_json(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


# --- TorchScript ----------------------------------------------------------------------------------


def _write_torchscript(graph: PolicyGraph, metadata: dict[str, Any]) -> bytes:
    file = io.BytesIO()
    with _quiet(), torch.no_grad():
        traced = torch.jit.trace(graph, _example(graph), check_trace=False)
        frozen = torch.jit.freeze(traced)  # removes the parts that only a training needs
        torch.jit.save(frozen, file, _extra_files={_METADATA_FILE: json.dumps(metadata)})
    return file.getvalue()


def _load_torchscript(file: Path) -> ExportedPolicy:
    extra = {_METADATA_FILE: ""}
    with _quiet():
        module = torch.jit.load(str(file), map_location="cpu", _extra_files=extra)
    metadata = json.loads(extra[_METADATA_FILE])
    inputs_in_order = [spec["name"] for spec in metadata["inputs"]]
    outputs_in_order = [spec["name"] for spec in metadata["outputs"]]

    def run(inputs: Arrays) -> dict[str, npt.NDArray[Any]]:
        with torch.no_grad():
            found = module(*(torch.from_numpy(np.array(inputs[name])) for name in inputs_in_order))
        tensors = found if isinstance(found, tuple) else (found,)
        arrays = (tensor.numpy() for tensor in tensors)
        return dict(zip(outputs_in_order, arrays, strict=True))

    return ExportedPolicy(metadata, run)


FORMATS = {
    "onnx": Format(".onnx", ("onnx", "onnxscript", "onnxruntime"), _write_onnx, _load_onnx),
    "torchscript": Format(".pt", (), _write_torchscript, _load_torchscript),
}
"""Maps each value of `format=` to its format."""
