"""The reader of torch's files: what it gives back, and what it refuses."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.checkpoints import files as checkpoints
from isaacgymenvs_lite.checkpoints.archive import ArchiveError, read_archive
from isaacgymenvs_lite.errors import CheckpointError


@pytest.fixture
def saved(tmp_path) -> Callable[..., Path]:
    """Return save(content), which writes a file as torch does."""

    def save(content: Any, zipped: bool = True) -> Path:
        path = tmp_path / "file.pth"
        torch.save(content, path, _use_new_zipfile_serialization=zipped)
        return path

    return save


def test_what_is_written_comes_back(saved):
    for zipped in [True, False]:
        generator = torch.Generator().manual_seed(0)
        memory = torch.rand(40, generator=generator)
        dtypes = (
            torch.float16,
            torch.bfloat16,
            torch.float64,
            torch.uint8,
            torch.int64,
            torch.bool,
        )
        content = {
            "tensors": [torch.randint(0, 2, (3, 2), generator=generator).to(d) for d in dtypes],
            "views": OrderedDict(first=memory[:8].view(2, 4), second=memory[8:23:2]),
            "turned": torch.rand(3, 5, generator=generator).t(),
            "none": torch.empty(0, 3),
            "parameter": torch.nn.Parameter(torch.ones(2)),
            "one": torch.tensor(1.5),
            "others": (1, -(2**40), 2.5, True, None, "text", {0: [], "a": ()}),
            "numpy": [np.float32(0.5), np.float64(0.25), np.int64(7), np.bool_(True)],
        }
        found = read_archive(saved(content, zipped))
        assert list(found) == list(content)
        for own, other in zip(found["tensors"], content["tensors"], strict=True):
            assert torch.equal(own, other)
            assert own.dtype == other.dtype
        for name in ("first", "second"):
            assert torch.equal(found["views"][name], content["views"][name])
        for name in ("turned", "none", "parameter", "one"):
            assert torch.equal(found[name], content[name])
            assert type(found[name]) is torch.Tensor
            assert found[name].is_contiguous()
            assert not found[name].requires_grad
        assert found["others"] == content["others"]
        assert found["numpy"] == [0.5, 0.25, 7, True]
        assert [type(number) for number in found["numpy"]] == [float, float, int, bool]


def test_a_number_of_numpy_1_is_read(saved):
    path = saved({"best": np.float32(3.5)}, zipped=False)
    path.write_bytes(path.read_bytes().replace(b"numpy._core.", b"numpy.core."))
    assert read_archive(path) == {"best": 3.5}


class Odd(torch.Tensor):
    """A subclass of tensors."""


REFUSED: dict[str, Callable[[], Any]] = {
    "sparse": lambda: torch.ones(3, 3).to_sparse(),
    "quantized": lambda: torch.quantize_per_tensor(torch.ones(3), 0.1, 0, torch.qint8),
    "meta": lambda: torch.empty(3, device="meta"),
    "nested": lambda: torch.nested.nested_tensor([torch.ones(2), torch.ones(3)]),
    "subclass": lambda: torch.ones(3).as_subclass(Odd),
    "numpy": lambda: np.arange(3),
    "set": lambda: {1, 2},
}


@pytest.mark.filterwarnings("ignore::UserWarning")  # torch's, about kinds that are in prototype
def test_only_plain_tensors_and_containers_are_read(saved):
    for kind in REFUSED:
        with pytest.raises(ArchiveError, match="refused, nothing was run"):
            read_archive(saved({"model": {"weight": REFUSED[kind]()}}))


def test_a_tensor_that_claims_more_memory_than_the_machine_has_is_refused(saved):
    with pytest.raises(ArchiveError, match="damaged"):
        read_archive(saved(torch.zeros(1).expand(10**7, 10**7)))  # 400 TB in 4 bytes


def test_entries_of_another_kind_are_named(saved):
    for state, words in [
        ({"model": {"weight": [1.0]}}, "model.weight is a list, expected a tensor"),
        ({"model": {}, "amp_input_mean_std": 3}, "amp_input_mean_std is a int"),
        ({"model": {}, "epoch": -1}, "epoch is -1, expected a number"),
        ({"model": {}, "frame": True}, "frame is True"),
        ({"model": {}, "epoch": "ten\nlines"}, "epoch is ten lines"),
        ({"model": {}, "last_mean_rewards": float("nan")}, "last_mean_rewards is nan"),
        ({"model": {}, "llc": {"checkpoint": 3}}, "llc is a dict"),
        ({"model": {}, "policy": {"settings": [1]}}, "policy is a dict, expected the settings"),
    ]:
        path = saved(state)
        with pytest.raises(CheckpointError, match=words) as caught:
            checkpoints.load_checkpoint(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
