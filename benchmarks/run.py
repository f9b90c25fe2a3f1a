"""All measurements one after another: `make bench`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]
_BENCHMARKS = ("benchmarks.env_step", "benchmarks.start_and_memory")


def main() -> None:
    """Run each benchmark in a process of its own."""
    for name in _BENCHMARKS:
        subprocess.run([sys.executable, "-m", name], cwd=_ROOT, check=True)


if __name__ == "__main__":
    main()
