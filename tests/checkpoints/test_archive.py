"""The reader of torch's files: what it gives back, and what it refuses."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.checkpoints import archive as checkpoint_archive
from isaacgymenvs_lite.checkpoints import files as checkpoints
from isaacgymenvs_lite.checkpoints.archive import ArchiveError, ForbiddenNameError, read_archive
from isaacgymenvs_lite.errors import CheckpointError


@pytest.fixture
def saved(tmp_path) -> Callable[..., Path]:
    """Return save(content), which writes a file as torch does."""

    def save(content: Any, zipped: bool = True) -> Path:
        path = tmp_path / "file.pth"
        torch.save(content, path, _use_new_zipfile_serialization=zipped)
        return path

    return save


@pytest.fixture
def edited(tmp_path) -> Callable[..., Path]:
    """Return edit(content, change): its archive after `change(members)`, with right checksums."""

    def edit(
        content: Any, change: Callable[[dict[str, bytes]], None], method: int = zipfile.ZIP_STORED
    ) -> Path:
        whole = io.BytesIO()
        torch.save(content, whole)
        with zipfile.ZipFile(whole) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        change(members)
        path = tmp_path / "edited.pth"
        with zipfile.ZipFile(path, "w", method) as archive:
            for name, data in members.items():
                archive.writestr(name, data)
        return path

    return edit


def replace_in_pickle(old: bytes, new: bytes) -> Callable[[dict[str, bytes]], None]:
    def change(members: dict[str, bytes]) -> None:
        assert old in members["archive/data.pkl"]
        members["archive/data.pkl"] = members["archive/data.pkl"].replace(old, new)

    return change


DTYPES = (
    *(torch.float16, torch.bfloat16, torch.float32, torch.float64),
    *(torch.int8, torch.uint8, torch.int16, torch.int32, torch.int64, torch.bool),
)


@pytest.mark.parametrize("zipped", [True, False], ids=["zip", "legacy"])
def test_what_is_written_comes_back(saved, zipped):
    generator = torch.Generator().manual_seed(0)
    memory = torch.rand(40, generator=generator)
    content = {
        "tensors": [torch.randint(0, 2, (3, 2), generator=generator).to(d) for d in DTYPES],
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


def test_a_tensor_owns_its_memory(saved):
    memory = torch.zeros(4)
    first, second = read_archive(saved([memory[:2], memory]))
    first += 1.0
    assert second.tolist() == [0.0] * 4


class Odd(torch.Tensor):
    """No plain tensor."""


ODD: dict[str, Callable[[], Any]] = {
    "sparse": lambda: torch.ones(3, 3).to_sparse(),
    "sparse rows": lambda: torch.ones(3, 3).to_sparse_csr(),
    "quantized": lambda: torch.quantize_per_tensor(torch.ones(3), 0.1, 0, torch.qint8),
    "meta": lambda: torch.empty(3, device="meta"),
    "nested": lambda: torch.nested.nested_tensor([torch.ones(2), torch.ones(3)]),
    "subclass": lambda: torch.ones(3).as_subclass(Odd),
    "complex": lambda: torch.ones(3, dtype=torch.complex64),
    "numpy": lambda: np.arange(3),
    "device": lambda: torch.device("cpu"),
    "set": lambda: {1, 2},
}


@pytest.mark.filterwarnings("ignore::UserWarning")  # torch's, about kinds that are in prototype
@pytest.mark.parametrize("kind", ODD)
def test_only_plain_tensors_and_containers_are_read(saved, kind):
    with pytest.raises(ForbiddenNameError):
        read_archive(saved({"model": {"weight": ODD[kind]()}}))


@pytest.mark.parametrize(
    "content",
    [
        torch.zeros(1).expand(10**6, 10**6),  # 4 TB in 4 bytes
        torch.zeros(2, 1).expand(2, 3),
        [torch.zeros(100, 100)] * 3 + [torch.zeros(1).expand(2)],
        10**30,
        "long" * 100_000,
        {1.5: 0},
        {(1, 2): 0},
        [0] * 200_001,
    ],
    ids=["huge", "expanded", "one of them", "number", "text", "float key", "tuple key", "many"],
)
def test_what_no_checkpoint_has_is_refused(saved, content):
    with pytest.raises(ArchiveError):
        read_archive(saved(content))


def test_many_views_of_one_memory_do_not_make_a_small_file_large(saved):
    memory = torch.zeros(100_000)
    assert len(read_archive(saved([memory[i:] for i in range(3)]))) == 3
    with pytest.raises(ArchiveError, match="larger than the file"):
        read_archive(saved([memory[i:] for i in range(20)]))


def test_a_tensor_that_claims_more_than_its_memory_is_refused(edited):
    # BININT1 7: the shape of a vector, then the length of its memory
    change = replace_in_pickle(b"K\x07\x85", b"K\x09\x85")
    with pytest.raises(ArchiveError, match="larger than its memory"):
        read_archive(edited([torch.zeros(7)], change))
    with pytest.raises(ArchiveError, match="of another size"):
        read_archive(edited([torch.zeros(7)], replace_in_pickle(b"K\x07", b"K\x09")))


def test_strides_beyond_the_memory_are_refused(edited):
    with pytest.raises(ArchiveError, match="larger than its memory"):
        read_archive(edited([torch.zeros(3, 2)], replace_in_pickle(b"K\x02K\x01", b"K\x70K\x01")))
    with pytest.raises(ArchiveError, match="impossible shape"):
        minus = b"J\xff\xff\xff\xff"
        read_archive(
            edited([torch.zeros(3, 2)], replace_in_pickle(b"K\x02K\x01", minus + b"K\x01"))
        )


def test_compressed_archives_are_refused(edited):
    path = edited([torch.zeros(1000)], lambda members: None, zipfile.ZIP_DEFLATED)
    with pytest.raises(ArchiveError, match="compressed"):
        read_archive(path)


@pytest.mark.parametrize(
    "program",
    [
        b"]" * (2**20 + 1),
        b"]q\x00" + b"".join(b"](" + b"h%c" % i * 10 + b"eq%c" % (i + 1) for i in range(60)),
        b"}N" + b"\x85" * 200_000 + b"K\x01s",
        b"]N" + b"\x85" * 200_000 + b"a",
        b"N\x96" + b"\xff" * 6 + b"\x00\x00",  # BYTEARRAY8 of 2^48 bytes
        b"Nr\xff\xff\xff\x7f",  # value number 2^31
        b"ccollections\nOrderedDict\n}X\x01\x00\x00\x00aK\x01sb",  # attributes of a function
    ],
    ids=["long", "laughs", "deep key", "deep", "bytes", "memo", "state"],
)
def test_hostile_pickles_cost_little(edited, program):
    def change(members: dict[str, bytes]) -> None:
        members["archive/data.pkl"] = b"\x80\x02" + program + b"."

    path = edited({}, change)
    with pytest.raises(CheckpointError):
        checkpoints.load_checkpoint(path)


def test_a_file_without_end_is_not_read(saved, monkeypatch):
    path = saved({"model": {"weight": torch.zeros(1000)}})
    monkeypatch.setattr(checkpoint_archive, "MAX_FILE_BYTES", 2000)
    with pytest.raises(ArchiveError, match="a file of"):
        read_archive(path)


def test_a_changed_number_is_noticed(saved):
    path = saved({"model": {"weight": torch.zeros(1000)}})
    content = bytearray(path.read_bytes())
    content[content.index(bytes(4000)) + 123] = 1
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="damaged"):
        checkpoints.load_checkpoint(path)


@pytest.mark.parametrize(
    ("state", "words"),
    [
        ({"model": {"weight": [1.0]}}, "model.weight is a list, expected a tensor"),
        ({"model": {}, "amp_input_mean_std": 3}, "amp_input_mean_std is a int"),
        ({"model": {}, "epoch": -1}, "epoch is -1, expected a number"),
        ({"model": {}, "frame": True}, "frame is True"),
        ({"model": {}, "epoch": "ten\nlines"}, "epoch is ten lines"),
        ({"model": {}, "last_mean_rewards": float("nan")}, "last_mean_rewards is nan"),
        ({"model": {}, "llc": {"checkpoint": 3}}, "llc is a dict"),
        ({"model": {}, "policy": {"settings": [1]}}, "policy is a dict, expected the settings"),
    ],
)
def test_entries_of_another_kind_are_named(saved, state, words):
    path = saved(state)
    with pytest.raises(CheckpointError, match=words) as caught:
        checkpoints.load_checkpoint(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_legacy_file_that_is_cut_is_refused(saved):
    whole = saved({"model": {"weight": torch.zeros(100)}}, zipped=False).read_bytes()
    path = saved({}).with_name("cut.pth")
    for size in range(0, len(whole), 97):
        path.write_bytes(whole[:size])
        with pytest.raises(CheckpointError, match=r"damaged|refused"):
            checkpoints.load_checkpoint(path)


def test_a_legacy_file_of_structure_alone_is_refused(saved, monkeypatch):
    monkeypatch.setattr(checkpoint_archive, "_MAX_STRUCTURE_BYTES", 10_000)
    path = saved({})
    path.write_bytes(
        pickle.dumps(0x1950A86A20F9469CFC6C, 2) + pickle.dumps(1001, 2) + b"]" * 20_000
    )
    with pytest.raises(ArchiveError, match="more structure"):
        read_archive(path)
