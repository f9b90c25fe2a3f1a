"""Writes the page of a run: one HTML file that needs no other."""

from __future__ import annotations

import base64
import html
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

from isaacgymenvs_lite import __version__
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.report.charts import Chart, main_charts, other_charts
from isaacgymenvs_lite.report.drawing import draw
from isaacgymenvs_lite.report.scalars import event_files, read_scalars
from isaacgymenvs_lite.report.summary import summarize
from isaacgymenvs_lite.utils.files import written_for_user

MAX_EMBEDDED_BYTES = 8 * 2**20
"""A larger video is linked instead, so that the page opens at once."""

_ASSETS = Path(__file__).with_name("assets")


def write_report(run: Path, out: Path | None = None) -> Path:
    """Write the page of a run and return its path.

    Args:
        run: folder of the run.
        out: the file; None = report.html in the folder.

    Raises:
        ConfigError: the folder is no run, has no scalars, or the file cannot be written.
    """
    out = out or run / "report.html"
    page = build_page(run, out)
    with written_for_user(out, "out") as partial:
        # Names of files may have bytes that are no UTF-8.
        partial.write_text(page, encoding="utf-8", errors="replace")
    return out


def build_page(run: Path, out: Path) -> str:
    """Return the page of a run as HTML.

    Args:
        run: folder of the run.
        out: where the page will be, for links to files that are too big for it.

    Raises:
        ConfigError: the folder is no run, or has no scalars.
    """
    _check_run(run)
    scalars = read_scalars(run / "summaries")
    if not scalars:
        raise ConfigError(f"{run}: no epoch has ended yet, so that there is nothing to show")
    config = _config_text(run)
    charts, others = main_charts(scalars), other_charts(scalars)
    resumed = any(chart.resumed_at for chart in charts)
    body = [
        f"<h1>{html.escape(run.absolute().name)}</h1>",
        _facts(summarize(run, config, scalars)),
        _video(run, out),
        "<h2>Curves over frames</h2>",
        _charts(charts),
        _folded(f"{len(others)} more scalars", _charts(others)) if others else "",
        _folded("config.yaml", f"<pre>{html.escape(config)}</pre>") if config else "",
        f"<footer>isaacgymenvs_lite {html.escape(__version__)}. Frames are environment"
        " steps; longer curves are drawn as means of neighbours."
        f"{' A dashed line marks where the training was resumed.' if resumed else ''}</footer>",
    ]
    style, script = (
        (_ASSETS / name).read_text(encoding="utf-8") for name in ("page.css", "page.js")
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(run.absolute().name)}</title>\n<style>\n{style}</style></head>\n"
        f"<body>\n{_joined(body)}\n<script>\n{script}</script>\n</body></html>\n"
    )


def _check_run(run: Path) -> None:
    if not run.is_dir():
        raise ConfigError(f"{run}: no such folder; expected the folder of a run, runs/<run>")
    try:
        str(run).encode()
    except UnicodeEncodeError as error:
        raise ConfigError(f"{run}: TensorBoard reads names in UTF-8; rename the folder") from error
    if not (run / "summaries").is_dir():
        raise ConfigError(
            f"{run}: is no run (it has no folder summaries); expected the folder of a run,"
            " runs/<run>"
        )
    if not event_files(run / "summaries"):
        raise ConfigError(
            f"{run}: no event files in its folder summaries; expected a run that was trained for"
            " one epoch at least"
        )


def _is_own(file: Path, run: Path) -> bool:
    """Whether a file lies in the run's folder; a link may show any other file."""
    return file.is_file() and file.resolve().is_relative_to(run.resolve())


def _config_text(run: Path) -> str:
    path = run / "config.yaml"
    if not _is_own(path, run):
        return ""  # rl_games' own runs have none
    try:
        with path.open("rb") as file:
            return file.read().decode("utf-8", errors="replace")
    except OSError:
        return ""


def _facts(facts: Mapping[str, str]) -> str:
    entries = (
        f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>"
        for name, value in facts.items()
    )
    return f"<dl>{''.join(entries)}</dl>"


def _charts(charts: Sequence[Chart]) -> str:
    return f'<div class="charts">{_joined([draw(chart) for chart in charts])}</div>'


def _folded(title: str, content: str) -> str:
    return f"<details><summary>{html.escape(title)}</summary>{content}</details>"


def _video(run: Path, out: Path) -> str:
    """Return the newest video of a run; '' if it has none."""
    own = (file for file in run.glob("videos/**/*.mp4") if _is_own(file, run))
    files = sorted(own, key=lambda file: file.stat().st_mtime)
    if not files:
        return ""
    file = files[-1]
    if file.stat().st_size <= MAX_EMBEDDED_BYTES:
        source = f"data:video/mp4;base64,{base64.b64encode(file.read_bytes()).decode()}"
    else:
        source = quote(
            os.path.relpath(file.absolute(), out.absolute().parent), errors="surrogateescape"
        )
    name = html.escape(str(file.relative_to(run)))
    return (
        f"<h2>{name}</h2>"
        f'<video src="{source}" title="{name}" controls loop muted playsinline></video>'
    )


def _joined(parts: Sequence[str]) -> str:
    return "\n".join(part for part in parts if part)
