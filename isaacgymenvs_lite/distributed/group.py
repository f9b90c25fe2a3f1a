"""Connects the processes that train one policy, and sends messages between them.

torchrun starts the processes; each has a rank from 0 to size - 1. Only this module imports
torch.distributed (rl_games also uses it, for gradients). Without torchrun the group has one process
and its messages return at once, so that most code works for one and for several processes.

All processes must call every method that sends a message, in the same order.
"""

from __future__ import annotations

import atexit
import contextlib
import datetime
import json
import logging
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous

from isaacgymenvs_lite.distributed import STARTS
from isaacgymenvs_lite.errors import ConfigError, PeerError, PeerMistakeError, UserError

log = logging.getLogger(__name__)

_VARIABLES = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
# Texts in the errors of torch's two backends about a process that has ended or hangs.
_LOST = ("connection closed", "connection reset", "broken pipe", "timed out", "gloo", "nccl")


@dataclass(frozen=True)
class ProcessGroup:
    """The group of a training's processes; `local_rank` and `local_size` count on one machine."""

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    local_size: int = 1

    @property
    def is_main(self) -> bool:
        """Whether this process decides, logs and writes for all."""
        return self.rank == 0

    def device_of(self, device: str) -> str:
        """Return the device of this process, given the device in the settings."""
        return f"cuda:{self.local_rank}" if device.startswith("cuda") and self.size > 1 else device

    # --- numbers ---------------------------------------------------------------------------

    def sum_(self, tensor: Tensor) -> Tensor:
        """Replace a tensor by its sum over all processes, and return it."""
        if self.size > 1:
            dist.all_reduce(tensor)
        return tensor

    def mean(self, tensor: Tensor) -> Tensor:
        """Return the mean of a tensor over all processes."""
        return tensor if self.size == 1 else self.sum_(tensor.detach().clone()) / self.size

    def smallest(self, number: int) -> int:
        """Return the smallest `number` of all processes."""
        return min(self.gather(number))

    def any(self, flag: bool) -> bool:
        """Return whether a flag is set in any process."""
        return max(self.gather(int(flag))) > 0

    def gather(self, number: int) -> list[int]:
        """Return `number` of every process in a list, ordered by rank."""
        if self.size == 1:
            return [number]
        numbers = torch.zeros(self.size, dtype=torch.int64)
        numbers[self.rank] = number
        return [int(each) for each in self.sum_(numbers).tolist()]

    # --- values of the main process --------------------------------------------------------

    def from_main(self, value: Any) -> Any:
        """Return the main process' value, which consists of JSON's types."""
        if self.size == 1:
            return value
        text = json.dumps(value).encode() if self.is_main else b""
        (length, *_others) = self.gather(len(text))
        content = torch.zeros(length, dtype=torch.uint8)
        if self.is_main:
            content.copy_(torch.frombuffer(bytearray(text), dtype=torch.uint8))
        dist.broadcast(content, 0)
        return json.loads(bytes(content.tolist()))

    def take_from_main_(self, tensors: Iterable[Tensor]) -> None:
        """Overwrite tensors by the main process' tensors of the same shapes."""
        if self.size == 1:
            return
        with torch.no_grad():
            for tensor in tensors:
                content = tensor.detach().contiguous()
                dist.broadcast(content, 0)
                tensor.copy_(content)

    # --- errors ----------------------------------------------------------------------------

    def check_equal(self, values: Mapping[str, Any], what: str) -> None:
        """Check that all processes have the same values, which consist of JSON's types.

        Raises:
            ConfigError: the values differ from the main process' values.
            PeerMistakeError: the values of another process differ.
        """
        expected = self.from_main(values)
        differing = sorted(
            key for key in {*values, *expected} if values.get(key) != expected.get(key)
        )
        error = None
        if differing:
            key = differing[0]
            more = f", and {len(differing) - 1} more" if len(differing) > 1 else ""
            error = ConfigError(
                f"rank {self.rank} has another {what} than rank 0: {key}={values.get(key)!r}, not"
                f" {expected.get(key)!r}{more}; start all processes with the same command"
            )
        self.fail_together(error)

    def fail_together(self, error: UserError | None = None) -> None:
        """End all processes if one of them has an error.

        Raises:
            UserError: `error`, in the first process that has an error.
            PeerMistakeError: another process has an error.
        """
        failed = [rank for rank, flag in enumerate(self.gather(int(error is not None))) if flag]
        if not failed:
            return
        if error is not None and failed[0] == self.rank:
            raise error
        raise PeerMistakeError(f"rank {self.rank} ends, because rank {failed[0]} does")

    @contextlib.contextmanager
    def together(self) -> Iterator[None]:
        """End all processes if one of them raises a `UserError` in this block."""
        try:
            yield
        except UserError as error:
            self.fail_together(error)
            raise
        self.fail_together()

    @contextlib.contextmanager
    def lost_peers_explained(self) -> Iterator[None]:
        """Turn torch's error about a lost process into a `PeerError`."""
        try:
            yield
        except RuntimeError as error:
            text = str(error).lower()
            if self.size == 1 or not any(words in text for words in _LOST):
                raise
            reason = "did not answer in time" if "timed out" in text else "ended"
            raise PeerError(
                f"rank {self.rank}: another process of this training {reason}; read its error in"
                " the output above or on its machine"
            ) from error


_TIMEOUT_OF_MISTAKES_S = 60.0

_current = ProcessGroup()


def current_group() -> ProcessGroup:
    """Return the group of this process."""
    return _current


@contextlib.contextmanager
def joined_group(
    device: str, timeout_s: float, mistake: UserError | None = None
) -> Iterator[ProcessGroup]:
    """Give the group of torchrun's processes; after the `with` statement each process is alone.

    The processes stay connected until they end, because torch cannot connect them a second time.

    Args:
        device: device of the networks; gloo connects CPUs, NCCL connects GPUs.
        timeout_s: time after which a process that does not answer counts as lost.
        mistake: an error of this process, which ends all processes.

    Raises:
        UserError: torchrun has not started this process, or a process has a mistake.
        PeerError: another process has not connected in time or has ended.
    """
    global _current
    missing = [name for name in _VARIABLES if not os.environ.get(name)]
    if missing:
        raise ConfigError(
            f"multi_gpu=True: torchrun has not started this process ({', '.join(missing)} not"
            " set); start several with torchrun --standalone --nproc-per-node=2 -m"
            " isaacgymenvs_lite.train ... multi_gpu=True, or train in one with multi_gpu=False"
        )
    group = ProcessGroup(*(int(os.environ[name]) for name in _VARIABLES[:4]))
    on_gpu = device.startswith("cuda")
    if on_gpu and group.local_size > torch.cuda.device_count():
        mistake = mistake or ConfigError(
            f"rl_device={device}: {group.local_size} processes on a machine with"
            f" {torch.cuda.device_count()} GPU(s); expected one each: give torchrun fewer with"
            " --nproc-per-node, or rl_device=cpu"
        )
    elif on_gpu:
        torch.cuda.set_device(group.local_rank)
    with group.lost_peers_explained():
        if not dist.is_initialized():
            _connect("cpu:gloo,cuda:nccl" if on_gpu else "gloo", timeout_s)
        former, _current = _current, group
        try:
            group.fail_together(mistake)
            yield group
        finally:
            _current = former


def _connect(backend: str, timeout_s: float) -> None:
    """Connect this process with the other processes."""
    timeout = datetime.timedelta(seconds=timeout_s)
    store, rank, size = next(rendezvous("env://", timeout=timeout))
    # The store may outlive the processes; new processes must not find addresses of old ones.
    counts = [os.environ.get(name, "0") for name in ("TORCHELASTIC_RESTART_COUNT", STARTS)]
    start = PrefixStore("start" + ".".join(counts), store)
    dist.init_process_group(backend, timeout=timeout, world_size=size, rank=rank, store=start)
    atexit.register(dist.destroy_process_group)


def first_of_all(error: UserError) -> UserError:
    """Return the error that this process should report before it joins the group.

    Usually all processes have the same mistake; only one process reports it.
    """
    if dist.is_initialized():
        return error
    try:
        with joined_group("cpu", _TIMEOUT_OF_MISTAKES_S, error):
            return error
    except UserError as first:
        return first if isinstance(first, PeerMistakeError) else error
