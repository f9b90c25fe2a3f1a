"""Writes the page of a run: one HTML file with a summary, curves, the settings and a video."""

from __future__ import annotations

import base64
import contextlib
import html
import io
from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
import yaml
from matplotlib.figure import Figure

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.report.scalars import FPS_TAGS, Series, event_files, first_of, read_scalars
from isaacgymenvs_lite.utils.files import written_for_user

MAX_VIDEO_BYTES = 8 * 2**20
_REWARD = ("rewards/frame", "rewards/step")
_LENGTH = ("episode_lengths/frame", "episode_lengths/step")
# Maps the title of each chart to a dictionary from labels of curves to tags. The first tag that the
# run has is drawn.
_CHARTS: dict[str, dict[str, tuple[str, ...]]] = {
    "Task reward of an episode": {"training": _REWARD, "mean policy": ("measured/reward",)},
    "Reward per step, by source": {
        "style": ("info/disc_reward_mean",),
        "encoder": ("info/enc_reward_mean",),
    },
    "Length of an episode, control steps": {"training": _LENGTH},
    "Pose error, m": {"mean policy": ("imitation/pose_error_m",)},
    "Share of the episodes": {
        "falls in training": ("info/fall_rate",),
        "off the clip in training": ("info/off_clip_rate",),
        "falls of the mean policy": ("measured/fall_rate",),
        "mean policy without a fall": ("imitation/no_fall_share",),
    },
    "Motion of the clip": {
        "tempo": ("imitation/tempo",),
        "share shown": ("imitation/motion_shown",),
    },
    "Discriminator accuracy": {
        "policy": ("info/disc_agent_acc",),
        "clips": ("info/disc_demo_acc",),
    },
}
# Maps the title of a chart to a prefix; the chart draws all tags that begin with the prefix.
_FAMILIES = {
    "Errors of the goal": "goal/",
    "Success of an episode": "success/",
    "Reward terms, per step": "reward_terms/",
    "Losses": "losses/",
}
# Maps the name of a fact to the tags of its scalar and to the format of the newest value.
_NEWEST = {
    "task reward of an episode": (_REWARD, "{:.4g}"),
    "measured reward": (("measured/reward",), "{:.4g}"),
    "measured falls": (("measured/fall_rate",), "{:.0%}"),
    "steps of an episode": (_LENGTH, "{:.4g}"),
    "style reward per step": (("info/disc_reward_mean",), "{:.3f}"),
    "pose error": (("imitation/pose_error_m",), "{:.3f} m"),
    "motion shown": (("imitation/motion_shown",), "{:.0%}"),
    "falls in training": (("info/fall_rate",), "{:.0%}"),
    "off the clip": (("info/off_clip_rate",), "{:.0%}"),
    "learning rate": (("info/last_lr",), "{:.3g}"),
}


def write_report(run: Path, out: Path | None = None) -> Path:
    """Write the page of a run, by default report.html in its folder, and return its path.

    Raises:
        ConfigError: the folder is not a run folder, has no scalars, or the file cannot be written.
    """
    out = out or run / "report.html"
    if not event_files(run / "summaries"):
        raise ConfigError(
            f"{run}: no event files in its folder summaries; expected the folder of a run,"
            " runs/<run>, that was trained for at least one epoch"
        )
    try:
        scalars = read_scalars(run / "summaries")
    except Exception as error:  # the reader raises many types of errors for damaged files
        raise ConfigError(f"{run}: its event files cannot be read ({error})") from error
    if not scalars:
        raise ConfigError(f"{run}: no epoch has ended yet; try again later")
    config_file = run / "config.yaml"  # runs of rl_games lack this file
    config = config_file.read_text("utf-8", "replace") if _is_own(config_file, run) else ""
    charts = "\n".join(_draw(title, lines) for title, lines in charts_of(scalars).items())
    title = html.escape(run.absolute().name)
    facts = "".join(
        f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>"
        for name, value in summarize(config, scalars).items()
    )
    style = Path(__file__).with_name("page.css").read_text(encoding="utf-8")
    page = f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>{style}</style></head>
<body><h1>{title}</h1>
<dl>{facts}</dl>
{_video(run)}
<h2>Curves over frames</h2>
<div class="charts">{charts}</div>
<details><summary>config.yaml</summary><pre>{html.escape(config)}</pre></details>
</body></html>
"""
    with written_for_user(out, "out") as partial:
        partial.write_text(page, encoding="utf-8", errors="replace")
    return out


def summarize(config: str, scalars: Mapping[str, Series]) -> dict[str, str]:
    """Return a dictionary from names to facts about the run, from config.yaml and the scalars."""
    clock = first_of(scalars, FPS_TAGS)
    facts = {"task": "", "algorithm": ""}
    with contextlib.suppress(Exception):  # a damaged file has no facts
        tree = yaml.safe_load(config)
        facts["task"] = str(tree["task"]["name"])
        facts["algorithm"] = str(tree["train"]["params"]["algo"]["name"])
    facts["frames"] = f"{clock.frames[-1]:,.0f}"
    facts["minutes trained"] = f"{clock.minutes[-1]:.1f}"
    facts["frames per second"] = f"{np.median(clock.values):,.0f}"
    for name, (tags, pattern) in _NEWEST.items():
        series = first_of(scalars, tags)
        facts[name] = pattern.format(series.last) if len(series) else ""
    for tag in sorted(scalars):
        if tag.startswith("success/"):
            name = tag.removeprefix("success/").replace("_", " ")
            facts[name] = f"{scalars[tag].last:.3g}"
    return {name: value for name, value in facts.items() if value}


def charts_of(scalars: Mapping[str, Series]) -> dict[str, dict[str, Series]]:
    """Map the titles of at most eleven charts to dictionaries from labels of curves to scalars."""
    charts = {
        title: {label: first_of(scalars, tags) for label, tags in lines.items()}
        for title, lines in _CHARTS.items()
    }
    for title, start in _FAMILIES.items():
        tags = [tag for tag in sorted(scalars) if tag.startswith(start)]
        charts[title] = {tag.removeprefix(start): scalars[tag] for tag in tags}
    kept = {
        title: {label: series for label, series in lines.items() if len(series)}
        for title, lines in charts.items()
    }
    return {title: lines for title, lines in kept.items() if lines}


def _draw(title: str, lines: Mapping[str, Series]) -> str:
    """Return a chart as an HTML element."""
    # Labels may come from the files of a stranger, so matplotlib must not read the labels as
    # formulas.
    with matplotlib.rc_context({"text.parse_math": False}):
        figure = Figure(figsize=(5.6, 2.8), dpi=100, layout="constrained")
        panel = figure.subplots()
        for label, series in lines.items():
            marker = "o" if len(series) == 1 else ""
            panel.plot(series.frames, series.values, label=label, linewidth=1.2, marker=marker)
        for start in sorted({start for line in lines.values() for start in line.resumed_at}):
            panel.axvline(start, color="0.5", linestyle="--", linewidth=0.8)
        panel.set_title(title, fontsize=10)
        panel.grid(alpha=0.3)
        if len(lines) > 1:
            panel.legend(fontsize=7)
        picture = io.BytesIO()
        figure.savefig(picture, format="png")
    data = base64.b64encode(picture.getvalue()).decode()
    return f'<img alt="{html.escape(title)}" src="data:image/png;base64,{data}">'


def _is_own(file: Path, run: Path) -> bool:
    """Return whether a file is in the run's folder; a link may point to any other file."""
    return file.is_file() and file.resolve().is_relative_to(run.resolve())


def _video(run: Path) -> str:
    """Return HTML with a run's newest video or, if it is large, its name; '' without a video."""
    own = (file for file in run.glob("videos/**/*.mp4") if _is_own(file, run))
    file = max(own, key=lambda file: file.stat().st_mtime, default=None)
    if file is None:
        return ""
    name = html.escape(str(file.relative_to(run)))
    if file.stat().st_size > MAX_VIDEO_BYTES:
        return f"<h2>{name}</h2>"
    data = base64.b64encode(file.read_bytes()).decode()
    source = f"data:video/mp4;base64,{data}"
    return f'<h2>{name}</h2><video src="{source}" controls loop muted playsinline></video>'
