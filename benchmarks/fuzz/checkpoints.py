"""Checkpoints of every agent and packed policies, restored by real agents and players."""

from __future__ import annotations

import atexit
import contextlib
import functools
import io
import os
import pickle
import random
import struct
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.fuzz.kinds import Kind
from benchmarks.fuzz.mutators import mutate_bytes, mutate_pickle, mutate_tree
from benchmarks.fuzz.trees import opened_agent
from isaacgymenvs_lite.checkpoints.files import load_checkpoint, save_checkpoint
from isaacgymenvs_lite.checkpoints.packed import read_policy_info, with_packed_settings
from isaacgymenvs_lite.checkpoints.policy_arguments import as_override
from isaacgymenvs_lite.checkpoints.shipped import shipped_policies
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.train_files import read_train_file
from isaacgymenvs_lite.errors import ConfigError, UserError

_CONFIG = "train.params.config"
_SMALL = (
    *("num_envs=2", "num_threads=1", "rl_device=cpu", "max_iterations=1"),
    "train.params.network.mlp.units=[16,8]",
    f"{_CONFIG}.mixed_precision=False",
)
_PPO = (*_SMALL, f"{_CONFIG}.horizon_length=4", f"{_CONFIG}.mini_epochs=1")
_AMP = (
    *_PPO,
    "train.params.network.disc.units=[12,6]",
    f"{_CONFIG}.amp_batch_size=16",
    f"{_CONFIG}.amp_obs_demo_buffer_size=16",
    f"{_CONFIG}.amp_replay_buffer_size=64",
)
_AGENTS: dict[str, tuple[str, ...]] = {
    "ppo": ("task=Cartpole", *_PPO),
    "sac": (
        *("task=AntSAC", "train=AntSAC", *_SMALL),
        f"{_CONFIG}.batch_size=16",
        f"{_CONFIG}.replay_buffer_size=200",
    ),
    "amp": ("task=HumanoidAMP", *_AMP),
    "gen_amp": (
        *("task=HumanoidASE", *_AMP),
        "train.params.network.style.units=[10,6]",
        "train.params.network.enc.units=[8]",
    ),
    "hrl": ("task=HumanoidHeading", *_PPO),
}


@functools.cache
def _opened(name: str) -> tuple[Any, Any]:
    """Return an agent and a player of the same networks, made once in a process."""
    stack = contextlib.ExitStack()
    runner, agent = stack.enter_context(opened_agent(compose(_AGENTS[name])))
    runner.params["config"]["vec_env"] = agent.vec_env.env
    with contextlib.redirect_stdout(io.StringIO()):
        player = runner.create_player()
    atexit.register(stack.close)
    return agent, player


def _writer(name: str) -> Any:
    def write(folder: Path) -> list[Path]:
        agent, _ = _opened(name)
        state = agent.get_full_state_weights()
        filled = _with_moments(agent, state)
        paths = []
        for number, content in enumerate((state, filled)):
            path = save_checkpoint(str(folder / f"agent{number}"), content)
            assert path is not None
            paths.append(path)
        return paths

    return write


def _with_moments(agent: Any, state: dict[str, Any]) -> dict[str, Any]:
    """Return a state whose optimisers have made a step, so that they have moments."""
    for key, value in list(vars(agent).items()):
        if isinstance(value, torch.optim.Optimizer) and key.endswith("optimizer"):
            for group in value.param_groups:
                for parameter in group["params"]:
                    parameter.grad = torch.full_like(parameter, 1e-3)
            value.step()
            value.zero_grad()
    return agent.get_full_state_weights()


def _restore(name: str) -> Any:
    def restore(path: Path) -> None:
        """Restore the agent, and the player also if the agent refuses: it needs less."""
        agent, player = _opened(name)
        refusal: UserError | None = None
        try:
            agent.restore(str(path))
        except UserError as error:
            refusal = error
        player.restore(str(path))
        if refusal is not None:
            raise refusal

    return restore


def _write_packed(folder: Path) -> list[Path]:
    paths = []
    for name, file in shipped_policies().items():
        content = load_checkpoint(file)
        # The networks are left out: megabytes that are nothing but numbers.
        small = {"model": dict(list(content["model"].items())[:2]), "policy": content["policy"]}
        path = save_checkpoint(str(folder / name), small)
        assert path is not None
        paths.append(path)
    return paths


def _read_packed(path: Path) -> None:
    """Read the settings of a packed policy as playing it and training over it do."""
    info = read_policy_info(path)
    str(info)
    words = [f"++{key}={as_override(value)}" for key, value in info.settings.items()]
    try:
        compose([f"task={info.task}", "~train.params.network", *words])
    except ConfigError as error:  # about a setting; the log has named the policy by then
        raise ConfigError(f"{path}: {error}") from error
    with_packed_settings(read_train_file("HumanoidASEPPO")["params"], load_checkpoint(path))


def _mutate(data: bytes, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """Break a checkpoint by its content, by the instructions of its pickle, or as bytes."""
    choice = rng.random()
    if choice < 0.15:
        return mutate_bytes(data, rng, others)
    if choice < 0.35:
        return _with_other_pickle(data, rng, others)
    content = torch.load(io.BytesIO(data), weights_only=True)  # our own file
    stream = io.BytesIO()
    try:
        broken = _as_tensors(mutate_tree(_as_arrays(content), rng), rng)
        torch.save(broken, stream, _use_new_zipfile_serialization=rng.random() < 0.9)
    except (RuntimeError, ValueError, RecursionError, OverflowError, pickle.PicklingError):
        return mutate_bytes(data, rng, others)
    return stream.getvalue()


def _with_other_pickle(data: bytes, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """Replace the pickle in an archive, with right checksums."""
    stream = io.BytesIO()
    method = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(stream, "w", method) as out:
        for name in archive.namelist():
            content = archive.read(name)
            if name.endswith("data.pkl"):
                content = mutate_pickle(content, rng, others)
            elif rng.random() < 0.02:
                content = mutate_bytes(content, rng, others)
            if rng.random() < 0.99:
                out.writestr(name, content)
    return stream.getvalue()


def _as_arrays(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return value.numpy()
    if isinstance(value, dict):
        return {key: _as_arrays(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_arrays(entry) for entry in value]
    return value


def _as_tensors(value: Any, rng: random.Random) -> Any:
    if isinstance(value, np.ndarray):
        with contextlib.suppress(TypeError, ValueError, RuntimeError):
            tensor = torch.from_numpy(np.ascontiguousarray(value).reshape(value.shape))
            return tensor.expand(3, *tensor.shape) if rng.random() < 0.02 else tensor
        return value
    if isinstance(value, dict):
        return {key: _as_tensors(entry, rng) for key, entry in value.items()}
    if isinstance(value, list):
        return [_as_tensors(entry, rng) for entry in value]
    return value


class _Code:
    """Runs a command when a pickle of it is loaded."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self._call = (function, arguments)

    def __reduce__(self) -> Any:
        return self._call


def _hostile(canary: Path) -> Iterable[tuple[str, bytes]]:
    """Yield files that run code, or promise more than they hold."""
    command = _Code(os.system, f"touch {canary}")
    source = _Code(eval, f"open({str(canary)!r}, 'w')")
    for name, code in (("system", command), ("eval", source)):
        for place, content in (
            ("model", {"model": code}),
            ("key", {"model": {}, "epoch": code}),
            ("file", code),
            ("weight", {"model": {"a": code}}),
        ):
            for zipped in (True, False):
                stream = io.BytesIO()
                torch.save(content, stream, _use_new_zipfile_serialization=zipped)
                yield f"code_{name}_{place}_{zipped}", stream.getvalue()
        yield f"raw_pickle_{name}", pickle.dumps({"model": code})
    yield "global", b"cposix\nsystem\n(S'touch " + str(canary).encode() + b"'\ntR."
    good = io.BytesIO()
    torch.save({"model": {"a": torch.zeros(7, 3)}}, good)
    whole = good.getvalue()
    for name, old, new in (
        ("huge_shape", struct.pack("<BB", 75, 7), struct.pack("<Bi", 74, 2**31 - 1)),
        ("huge_storage", b"K\x15", b"J" + struct.pack("<i", 2**31 - 1)),
    ):
        yield name, _replaced(whole, old, new)
    yield "empty", b""
    yield "zip_alone", b"PK\x03\x04" + bytes(100)
    yield "deep", _pickled_archive(b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b".")
    yield "memo", _pickled_archive(b"\x80\x02]" + b"q\x00h\x00h\x00\x86" * 60 + b".")
    yield "doubled", _pickled_archive(b"\x80\x02K\x01" + b"2\x86" * 64 + b".")
    yield "long_integer", _pickled_archive(b"\x80\x02\x8b" + struct.pack("<i", 2**31 - 1) + b"1.")
    yield "long_text", _pickled_archive(b"\x80\x02X" + struct.pack("<I", 2**32 - 1) + b"a.")
    yield "memo_index", _pickled_archive(b"\x80\x02]r" + struct.pack("<I", 2**31) + b".")


def _replaced(archive: bytes, old: bytes, new: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(archive)) as members:
        (name,) = (name for name in members.namelist() if name.endswith("data.pkl"))
        return _pickled_archive(members.read(name).replace(old, new), archive)


def _pickled_archive(content: bytes, archive: bytes | None = None) -> bytes:
    """Return an archive with this pickle, and the other parts of another archive."""
    if archive is None:
        empty = io.BytesIO()
        torch.save({}, empty)
        archive = empty.getvalue()
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as members, zipfile.ZipFile(stream, "w") as out:
        for name in members.namelist():
            out.writestr(name, content if name.endswith("data.pkl") else members.read(name))
    return stream.getvalue()


KINDS = (
    *(
        Kind(f"{name}_checkpoints", ".pth", _writer(name), _restore(name), _mutate, _hostile)
        for name in _AGENTS
    ),
    Kind("packed_policies", ".pth", _write_packed, _read_packed, _mutate, _hostile),
)
