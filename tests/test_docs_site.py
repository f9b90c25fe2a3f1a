"""The documentation as a site, and the links of all pages as the repository's host shows them."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [*ROOT.glob("*.md"), *sorted((ROOT / "docs").glob("*.md"))]
LINK = re.compile(r"\]\(([^()\s]+)\)|(?:src|href)=\"([^\"]+)\"")
FENCED = re.compile(r"^```.*?^```", re.M | re.S)


def text_of(page: Path) -> str:
    """A page without its code."""
    return FENCED.sub("", page.read_text(encoding="utf-8"))


def anchors(page: Path) -> set[str]:
    """Anchors of the headings, as hosts make them: small letters, digits, hyphens."""
    headings = re.findall(r"^#+ (.*)$", text_of(page), re.M)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def links(page: Path) -> set[str]:
    found = LINK.findall(re.sub(r"`[^`\n]*`", "", text_of(page)))
    return {link for pair in found if not re.match(r"[a-z]+:", link := "".join(pair))}


def test_links_lead_somewhere() -> None:
    for page in PAGES:
        for link in links(page):
            file, _, anchor = link.partition("#")
            target = (page.parent / file).resolve() if file else page
            assert target.exists(), (page, link)
            assert not anchor or anchor in anchors(target), (page, link)


def test_links_and_pictures_are_found() -> None:
    shown = {link for page in PAGES for link in links(page)}
    assert "reading_a_run.md#is-it-learning" in shown
    pictures = {file.name for file in (ROOT / "docs" / "images").iterdir()}
    assert pictures == {Path(link).name for link in shown if "images/" in link}


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("sphinx")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html"]
    folders = [str(ROOT / "docs"), str(tmp_path / "site")]
    result = subprocess.run([*command, *folders], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    api = (tmp_path / "site" / "api.html").read_text(encoding="utf-8")
    assert 'id="isaacgymenvs_lite.make"' in api
    assert re.search(r"<td>.{0,200}_load_config_params", api, re.S), (
        "tables of docstrings are drawn"
    )
