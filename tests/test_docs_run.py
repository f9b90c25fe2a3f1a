"""Commands of the pages that are marked to run do run: `<!-- run -->` before their block."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
MARKED = re.compile(r"^<!-- run -->\n\n((?:    .*\n)+)", re.M)
# A checkout's programs are this interpreter's, in an empty folder.
PROGRAMS = {
    "isaacgymenvs-lite": (sys.executable, "-m", "isaacgymenvs_lite"),
    "python": (sys.executable,),
}
BLOCKS = [
    pytest.param(block[1], id=f"{page.name}:{number}")
    for page in PAGES
    for number, block in enumerate(MARKED.finditer(page.read_text(encoding="utf-8")), 1)
]


def test_some_pages_have_blocks_that_run() -> None:
    assert len(BLOCKS) >= 4
    marks = sum(page.read_text(encoding="utf-8").count("<!-- run -->") for page in PAGES)
    assert marks == len(BLOCKS), "a mark without an indented block after it"


@pytest.mark.slow
@pytest.mark.parametrize("block", BLOCKS)
def test_the_block_runs(block: str, tmp_path: Path) -> None:
    for line in block.splitlines():
        program, *words = shlex.split(line, comments=True)
        result = subprocess.run(
            [*PROGRAMS[program], *words],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert result.returncode == 0, f"{line}\n{result.stdout}{result.stderr}"
