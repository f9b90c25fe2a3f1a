"""Connects the processes that train one policy, and sends messages between them.

torchrun starts the processes and gives each process a rank from 0 to size - 1. In this package only
this module imports torch.distributed; rl_games uses torch.distributed for gradients. Without
torchrun the group consists of one process and sends no messages, so that callers need not
distinguish one process from several.

All processes must call the methods that send messages in the same order.
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
# Texts by which the errors of torch's two backends report a process that has ended or hangs.
_LOST = ("connection closed", "connection reset", "broken pipe", "timed out", "gloo", "nccl")


@dataclass(frozen=True)
class ProcessGroup:
    """All processes of a training; `local_rank` and `local_size` count those on one machine."""

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    local_size: int = 1

    @property
    def is_main(self) -> bool:
        """Whether this process decides, logs and writes files for all processes."""
        return self.rank == 0

    def device_of(self, device: str) -> str:
        """Return the device that this process uses if the settings contain `device`."""
        return f"cuda:{self.local_rank}" if device.startswith("cuda") and self.size > 1 else device

    # --- numbers ---------------------------------------------------------------------------

    def sum_(self, tensor: Tensor) -> Tensor:
        """Replace a tensor by its sum over all processes, and return the tensor."""
        if self.size > 1:
            dist.all_reduce(tensor)
        return tensor

    def mean(self, tensor: Tensor) -> Tensor:
        """Return the mean of a tensor over all processes."""
        return tensor if self.size == 1 else self.sum_(tensor.detach().clone()) / self.size

    def smallest(self, number: int) -> int:
        """Return the smallest `number` that a process passes to this method."""
        return min(self.gather(number))

    def any(self, flag: bool) -> bool:
        """Return whether `flag` is True in at least one process."""
        return max(self.gather(int(flag))) > 0

    def gather(self, number: int) -> list[int]:
        """Return a list of the values of `number` in all processes, ordered by rank."""
        if self.size == 1:
            return [number]
        numbers = torch.zeros(self.size, dtype=torch.int64)
        numbers[self.rank] = number
        return [int(each) for each in self.sum_(numbers).tolist()]

    # --- values of the main process --------------------------------------------------------

    def from_main(self, value: Any) -> Any:
        """Return the main process' `value`, which must consist of JSON's types."""
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
        """Check that all processes pass the same values, which must consist of JSON's types.

        Raises:
            ConfigError: this process' values differ from the main process' values.
            PeerMistakeError: another process' values differ from the main process' values.
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
            UserError: this is the first process that has an error; it raises `error`.
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
        """End all processes if one process raises a `UserError` in this block."""
        try:
            yield
        except UserError as error:
            self.fail_together(error)
            raise
        self.fail_together()

    @contextlib.contextmanager
    def lost_peers_explained(self) -> Iterator[None]:
        """Raise a `PeerError` in place of torch's error about a lost process."""
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
    """Return the group to which this process belongs."""
    return _current


@contextlib.contextmanager
def joined_group(
    device: str, timeout_s: float, mistake: UserError | None = None
) -> Iterator[ProcessGroup]:
    """Make torchrun's processes the current group during a `with` statement.

    The processes stay connected until they end, because torch cannot connect processes twice.

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
    # The store may outlive the processes; restarted processes must not find old addresses in it.
    counts = [os.environ.get(name, "0") for name in ("TORCHELASTIC_RESTART_COUNT", STARTS)]
    start = PrefixStore("start" + ".".join(counts), store)
    dist.init_process_group(backend, timeout=timeout, world_size=size, rank=rank, store=start)
    atexit.register(dist.destroy_process_group)


def first_of_all(error: UserError) -> UserError:
    """Return the error that this process should report before it joins the group.

    Usually all processes have the same mistake; only one process reports the mistake.
    """
    if dist.is_initialized():
        return error
    try:
        with joined_group("cpu", _TIMEOUT_OF_MISTAKES_S, error):
            return error
    except UserError as first:
        return first if isinstance(first, PeerMistakeError) else error
