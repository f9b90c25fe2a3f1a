"""Runs all benchmarks of speed and memory in about eight minutes: `make bench`.

docs/protocol.md describes the commands that measure learning.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]
_BENCHMARKS = (
    "benchmarks.env_step",
    "benchmarks.start_and_memory",
    "benchmarks.training_speed --units 512 256",
    "benchmarks.training_speed --units 1024 512",
    "benchmarks.training_speed --units 1024 512 --compare",
)


def main() -> None:
    """Run each benchmark in a separate process."""
    for command in _BENCHMARKS:
        print(f"\n$ python -m {command}\n", flush=True)
        subprocess.run([sys.executable, "-m", *command.split()], cwd=_ROOT, check=True)


if __name__ == "__main__":
    main()
