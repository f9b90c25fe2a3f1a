"""Writes a report of a run, one HTML page: isaacgymenvs-lite report runs/<run>.

    isaacgymenvs-lite report runs/HumanoidAMP_22-10-15-30             # report.html in it
    isaacgymenvs-lite report runs/HumanoidAMP_22-10-15-30 out=walk.html

The page contains the curves, the configuration and the last video of the run.
"""

from __future__ import annotations

import argparse
import logging
import sys
from dataclasses import dataclass
from pathlib import Path

from isaacgymenvs_lite.command_line import run_command
from isaacgymenvs_lite.report.page import write_report
from isaacgymenvs_lite.schema import setting

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ReportSettings:
    """Arguments of the command in addition to the run."""

    out: str = setting("")
    """Path of the report; '' means report.html in the run's folder."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="isaacgymenvs-lite report", description=__doc__)
    parser.add_argument("run", type=Path, help="folder of the run")
    words = argparse.Namespace()

    def report(settings: ReportSettings) -> None:
        path = write_report(words.run, Path(settings.out) if settings.out else None)
        log.info("%s: %.1f MiB", path, path.stat().st_size / 2**20)

    return run_command(parser, ReportSettings, report, arguments, words)


if __name__ == "__main__":
    sys.exit(main())
