"""Chooses the precision of networks according to a key or to a short measurement.

`mixed_precision: True` means bfloat16 on a GPU and on a CPU with instructions for bfloat16; The
autocast of rl_games has no effect on a CPU. Other CPUs (most laptops) emulate bfloat16, which is
several times slower than float32 and impossible for LSTMs. `auto` measures on the CPU whether
bfloat16 is faster.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.utils.threads import one_torch_thread

log = logging.getLogger(__name__)

# Least measured speed-up for bfloat16. The casts of autocast cost a fraction of the gain.
_MIN_SPEEDUP = 1.3
_CALIBRATION_ROWS = 1024
_CALIBRATION_UNITS = 512
_CALIBRATION_ROUNDS = 15


def resolve_mixed_precision(value: Any, device: str | torch.device) -> bool:
    """Return whether to compute in bfloat16 on `device`.

    Args:
        value: value of `train.params.config.mixed_precision`: True, False or "auto". True means
            float32 on a CPU without instructions for bfloat16.
        device: device of the networks. `auto` means False on a GPU, as in published files.

    Raises:
        ConfigError: `value` is not True, False or "auto".
    """
    on_cpu = torch.device(device).type == "cpu"
    if value is True and on_cpu and not supports_bfloat16():
        log.info(
            "mixed_precision=True: this CPU has no instructions for bfloat16; using float32, which"
            " is faster here"
        )
        return False
    if isinstance(value, bool):
        return value
    if value != "auto":
        raise ConfigError(
            f"train.params.config.mixed_precision={value!r}: expected True, False or auto"
        )
    if not on_cpu:
        return False
    speedup = measure_bfloat16_speedup()
    chosen = speedup >= _MIN_SPEEDUP
    log.info(
        "mixed_precision=auto: bfloat16 is %.1f times as fast as float32 on this CPU; using %s",
        speedup,
        "bfloat16" if chosen else "float32",
    )
    return chosen


def supports_bfloat16() -> bool:
    """Return whether this CPU has instructions with which oneDNN computes in bfloat16."""
    # oneDNN's layers make the same check; torch's public functions only name instruction sets.
    return torch.backends.mkldnn.is_available() and bool(
        torch.ops.mkldnn._is_mkldnn_bf16_supported()
    )


def measure_bfloat16_speedup() -> float:
    """Return a layer's time in float32, forwards and backwards, divided by its time in bfloat16."""
    # The measurement must not change the random numbers of the run.
    with torch.random.fork_rng(devices=[]):
        layer = torch.nn.Linear(_CALIBRATION_UNITS, _CALIBRATION_UNITS)
        rows = torch.rand(_CALIBRATION_ROWS, _CALIBRATION_UNITS)

    def run(enabled: bool) -> Callable[[], None]:
        def once() -> None:
            with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
                loss = layer(rows).float().square().mean()
            loss.backward()

        return once

    full, half = run(False), run(True)
    with one_torch_thread():  # the rollout evaluates the networks on one thread
        full()
        half()
        # Alternating measurements and their shortest times reduce the influence of other work on
        # the machine.
        times = [(_time_s(full), _time_s(half)) for _ in range(_CALIBRATION_ROUNDS)]
    return min(full_s for full_s, _ in times) / min(half_s for _, half_s in times)


def _time_s(work: Callable[[], None]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start
