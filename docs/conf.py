"""Settings of the documentation site: make docs."""

from __future__ import annotations

import importlib.metadata
from itertools import groupby
from typing import Any

project = "isaacgymenvs_lite"
author = "The isaacgymenvs_lite authors"
project_copyright = "2026, the isaacgymenvs_lite authors"
release = version = importlib.metadata.version("isaacgymenvs-lite")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]
html_theme = "furo"
html_title = "isaacgymenvs_lite"
exclude_patterns = ["_build"]

# Pages are read on the repository's host as well: plain Markdown, links to files and headings.
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]

# Docstrings write `names` as in Markdown.
default_role = "code"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True  # attributes that are fields of a dataclass are described once
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True}
copybutton_exclude = ".linenos, .gp"


def tables_of_docstrings(
    app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    """Rewrite the Markdown tables of a docstring as tables of reStructuredText, in place."""
    rewritten = list[str]()
    for is_table, rows in groupby(lines, lambda line: line.startswith("|")):
        if not is_table:
            rewritten += rows
            continue
        rewritten += [".. list-table::", "   :header-rows: 1", ""]
        for row in rows:
            cells = [cell.strip() for cell in row.strip("|").split("|")]
            if not all(set(cell) == {"-"} for cell in cells):
                rewritten += [f"   {'  -' if i else '* -'} {c}" for i, c in enumerate(cells)]
    lines[:] = rewritten


def setup(app: Any) -> None:
    """Connect the functions of this file; Sphinx calls it."""
    app.connect("autodoc-process-docstring", tables_of_docstrings)
