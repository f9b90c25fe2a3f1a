"""Draws charts as SVG elements of a page.

Not with matplotlib: for 46 charts of 300 points its SVG took 50 times as long to draw and was four
times as large, with fixed colours and ids that repeat on a page. Here colours (light and dark),
fonts and the values under the pointer are the page's (`assets/page.css`, `assets/page.js`), and the
command needs no extra.
"""

from __future__ import annotations

import html
import json
import math
from collections.abc import Callable

import numpy as np

from isaacgymenvs_lite.report.charts import Chart, Line
from isaacgymenvs_lite.report.scalars import FloatArray, Series

WIDTH, HEIGHT = 560, 250
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 12, 12, 30
_TICKS = 5
_POINTS = 300
# Of the range of the values, so that no curve runs along the frame.
_MARGIN = 0.05
_SIGNIFICANT_DIGITS = 5


def draw(chart: Chart) -> str:
    """Return a chart as a `<figure>`: title, legend, axes, curves, and the values of the points.

    Longer curves are thinned to about 300 points, each the mean of its neighbours. A dashed line
    marks where the training was resumed.
    """
    lines = [Line(line.label, thinned(line.series)) for line in chart.lines]
    frames = np.concatenate([line.series.frames for line in lines])
    values = np.concatenate([line.series.values for line in lines])
    low_x, high_x = _widened(frames.min(), frames.max(), 0.0)
    low_y, high_y = _widened(values.min(), values.max(), _MARGIN)

    def x_of(frame: FloatArray | float) -> FloatArray | float:
        return _LEFT + (frame - low_x) / (high_x - low_x) * (WIDTH - _LEFT - _RIGHT)

    def y_of(value: FloatArray | float) -> FloatArray | float:
        return HEIGHT - _BOTTOM - (value - low_y) / (high_y - low_y) * (HEIGHT - _TOP - _BOTTOM)

    title = html.escape(chart.title)
    parts = [
        f'<figure class="chart"><figcaption>{title}{_legend(lines)}</figcaption>',
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{title}">',
        *_axes((low_x, high_x), (low_y, high_y), x_of, y_of),
    ]
    for start in chart.resumed_at:
        if low_x < start < high_x:
            x = f"{x_of(start):.1f}"
            y = f'y1="{_TOP}" y2="{HEIGHT - _BOTTOM}"'
            parts.append(f'<line class="resumed" x1="{x}" x2="{x}" {y}/>')
    data = []
    for i, line in enumerate(lines):
        xs, ys = np.asarray(x_of(line.series.frames)), np.asarray(y_of(line.series.values))
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(xs, ys, strict=True))
        parts.append(f'<polyline class="line line{i}" points="{points}"/>')
        if len(xs) == 1:
            parts.append(f'<circle class="dot line{i}" cx="{xs[0]:.1f}" cy="{ys[0]:.1f}" r="3"/>')
        data.append(
            {
                "label": line.label,
                "x": [round(float(x), 1) for x in xs],
                "y": [round(float(y), 1) for y in ys],
                "frames": [round(float(frame)) for frame in line.series.frames],
                "minutes": [round(float(minute), 1) for minute in line.series.minutes],
                "values": [float(f"{v:.{_SIGNIFICANT_DIGITS}g}") for v in line.series.values],
            }
        )
    parts.append(f'<line class="cursor" y1="{_TOP}" y2="{HEIGHT - _BOTTOM}"/></svg>')
    # "</" would end the script element, "<!--" would let it go on
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    parts.append(f'<script type="application/json">{text}</script><output></output></figure>')
    return "".join(parts)


def _legend(lines: list[Line]) -> str:
    if len(lines) == 1:
        return ""
    entries = (
        f'<span class="key line{i}">{html.escape(line.label)}</span>'
        for i, line in enumerate(lines)
    )
    return " ".join(("", *entries))


def _axes(
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    x_of: Callable[[float], FloatArray | float],
    y_of: Callable[[float], FloatArray | float],
) -> list[str]:
    parts = []
    for value in ticks(*y_range):
        y = f"{y_of(value):.1f}"
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{y}" y2="{y}"/>')
        text = short(value)
        parts.append(f'<text class="tick y" x="{_LEFT - 6}" y="{y}">{text}</text>')
    bottom = HEIGHT - _BOTTOM
    parts.append(
        f'<line class="axis" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{bottom}" y2="{bottom}"/>'
    )
    for value in ticks(*x_range):
        x = f"{x_of(value):.1f}"
        parts.append(f'<text class="tick x" x="{x}" y="{bottom + 18}">{short(value)}</text>')
    return parts


def _widened(low: float, high: float, margin: float) -> tuple[float, float]:
    """Return a range with a margin; one of no width becomes one around its value."""
    if high > low:
        return low - margin * (high - low), high + margin * (high - low)
    around = 0.5 * abs(low) or 1.0
    return low - around, high + around


def ticks(low: float, high: float) -> list[float]:
    """Return about five round numbers from `low` to `high`, low < high."""
    rough = (high - low) / _TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= 0.999 * rough)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def short(value: float) -> str:
    """Return a number with few letters: 1.5M, 20k, 0.25, 5e-05."""
    for unit, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= unit:
            return f"{value / unit:.4g}{letter}"
    return f"{value:.4g}"


def thinned(series: Series) -> Series:
    """Return a series of at most 300 points: means over as many equal parts of it."""
    if len(series) <= _POINTS:
        return series
    starts = np.linspace(0, len(series), _POINTS, endpoint=False).astype(int)
    counts = np.diff(np.append(starts, len(series)))
    columns = (series.frames, series.minutes, series.values)
    means = (np.add.reduceat(column, starts) / counts for column in columns)
    return Series(*means, resumed_at=series.resumed_at)
