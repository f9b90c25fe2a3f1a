"""The page as a file, and as headless Chromium shows it."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from isaacgymenvs_lite.report import page as page_module
from isaacgymenvs_lite.report.__main__ import main
from isaacgymenvs_lite.report.charts import Chart, Line
from isaacgymenvs_lite.report.drawing import draw
from isaacgymenvs_lite.report.page import write_report
from isaacgymenvs_lite.report.scalars import Series
from tests.report.conftest import AMP, CONFIG, PPO

VOID = {"meta", "line", "polyline", "circle"}


class Page(HTMLParser):
    """What a page consists of; complains of elements that are not closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.resources: list[str] = []
        self.titles: list[str] = []
        self.facts: dict[str, str] = {}
        self.config = ""
        self.data: list[list[dict]] = []
        self._name = ""
        self._json = False
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.resources += [values[key] for key in ("src", "href") if key in values]
        if tag == "svg":
            self.titles.append(values["aria-label"])
        self._json = values.get("type") == "application/json"
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert tag in VOID or self.open.pop() == tag

    def handle_startendtag(self, tag, attrs):
        assert tag in VOID

    def handle_data(self, data):
        tag = self.open[-1] if self.open else ""
        if tag == "dt":
            self._name = data
        elif tag == "dd":
            self.facts[self._name] = data
        elif tag == "pre":
            self.config += data
        elif tag == "script" and self._json:
            self.data.append(json.loads(data))


def read(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


def test_a_run_on_one_page(make_run) -> None:
    run = make_run(AMP)
    path = write_report(run)
    assert path == run / "report.html"
    page = read(path)
    assert page.facts == {
        "task": "HumanoidAMP",
        "algorithm": "amp_agent",
        "networks": "amp",
        "frames": "300",
        "epochs": "3",
        "minutes trained": "3.0",
        "frames per second": "110",
        "task reward of an episode": "30",
        "steps of an episode": "60",
        "style reward per step": "0.750",
        "pose error": "0.062 m",
        "falls in training": "25%",
        "off the clip": "20%",
        "discriminator accuracy": "0.70",
        "learning rate": "5e-05",
        "velocity_error_m_s": "0.250",
        "newest checkpoint": "nn/last.pth",
    }
    assert page.config == CONFIG
    assert page.resources == []
    assert len(page.titles) == len(page.data) == 13 + 2
    (accuracy,) = (d for t, d in zip(page.titles, page.data, strict=True) if "accuracy" in t)
    assert [line["label"] for line in accuracy] == ["both", "policy", "clips"]
    assert accuracy[0]["values"] == pytest.approx([0.9, 0.8, 0.7])
    assert accuracy[0]["frames"] == [0, 100, 200]
    text = path.read_text()
    assert not re.search(r"https?:|//cdn|@import|url\(", text)
    assert text.count("<polyline") == sum(map(len, page.data))


def test_a_run_of_rl_games_without_our_files(make_run) -> None:
    page = read(write_report(make_run(PPO, config="")))
    assert page.facts["task reward of an episode"] == "3"
    assert page.facts["frames per second"] == "20k"
    assert "task" not in page.facts
    assert page.config == ""


@pytest.mark.parametrize("config", ["task: [", "just text", "task: {name: [1, 2]}"])
def test_a_damaged_configuration_is_shown_as_it_is(config, make_run) -> None:
    assert read(write_report(make_run(AMP, config=config))).config == config


def add_video(run: Path, name: str, content: bytes, mtime: int) -> None:
    file = run / "videos" / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content)
    os.utime(file, (mtime, mtime))


def test_the_last_video_is_embedded(make_run) -> None:
    run = make_run(AMP)
    add_video(run, "step-200.mp4", b"newer", 2000)
    add_video(run, "step-0.mp4", b"older", 1000)
    (source,) = read(write_report(run)).resources
    assert base64.b64decode(source.removeprefix("data:video/mp4;base64,")) == b"newer"


def test_a_long_video_is_linked(make_run, monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(page_module, "MAX_EMBEDDED_BYTES", 3)
    run = make_run(AMP)
    add_video(run, "a #1.mp4", b"long", 1000)
    assert read(write_report(run)).resources == ["videos/a%20%231.mp4"]
    elsewhere = write_report(run, tmp_path / "pages" / "run.html")
    assert read(elsewhere).resources == ["../runs/run/videos/a%20%231.mp4"]


HOSTILE = "<!--<script>alert(1)<img src=x onerror=alert(2)>'\""


def test_names_and_texts_of_files_are_no_html(make_run) -> None:
    config = f"# {HOSTILE}</pre></script><script>alert(3)</script>\n"
    run = make_run(AMP, config=config, name=HOSTILE)
    (run / "nn" / f"{HOSTILE}.pth").touch()
    add_video(run, f"{HOSTILE}\udcff.mp4", b"video", 1000)  # with a byte that is no UTF-8
    path = write_report(run)
    page, text = read(path), path.read_text(encoding="utf-8")
    assert page.config == config
    assert page.facts["newest checkpoint"] in (f"nn/{HOSTILE}.pth", "nn/last.pth")
    assert len(page.resources) == 1  # the video
    assert not re.search(r"<!--|<img|<script>alert", text)


def test_names_of_scalars_are_no_html() -> None:
    """Event files may have any; "<!--<script>" would keep the end of a script from ending it."""
    series = Series(*np.ones((3, 1)))
    lines = (Line(HOSTILE, series), Line("</script>", series))
    text = draw(Chart(HOSTILE, lines))
    page = Page(text)
    assert page.titles == [HOSTILE]
    assert [line["label"] for line in page.data[0]] == [HOSTILE, "</script>"]
    assert not re.search(r"<!--|<img|<script>", text)
    assert text.count("</script>") == 1


@pytest.mark.parametrize("kind", ["link", "linked folder", "dangling link", "pipe", "folder"])
def test_files_outside_of_the_run_are_not_on_its_page(kind, make_run, tmp_path) -> None:
    """A run of somebody else may have a link to a file of the user, who then shows the page."""
    (tmp_path / "secret").mkdir()
    secret = tmp_path / "secret" / "secret.mp4"
    secret.write_text("secret of the user")
    run = make_run(AMP, config="")
    videos = run / "videos"
    if kind == "linked folder":
        videos.symlink_to(secret.parent)
        files = []
    else:
        videos.mkdir()
        names = ("videos/a.mp4", "config.yaml", "nn/a.pth", "summaries/events.out.tfevents.0")
        files = [run / name for name in names]
    for file in files:
        file.unlink(missing_ok=True)
        if kind == "pipe":
            os.mkfifo(file)
        elif kind == "folder":
            file.mkdir()
        else:
            file.symlink_to(secret if kind == "link" else tmp_path / "absent")
    page = read(write_report(run))
    assert page.resources == []
    assert page.config == ""
    assert page.facts["epochs"] == "3"


def test_the_command(make_run, tmp_path, caplog) -> None:
    run = make_run(AMP, name="a=b")
    with caplog.at_level("INFO"):
        assert main([str(run), f"out={tmp_path}/deep/page.html"]) == 0
    assert read(tmp_path / "deep" / "page.html").facts["task"] == "HumanoidAMP"
    assert f"{tmp_path}/deep/page.html: 0.0 MiB" in caplog.text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["absent"], "absent: no such folder; expected the folder of a run, runs/<run>"),
        (["empty"], "empty: is no run (it has no folder summaries)"),
        (["bare"], "bare: no event files in its folder summaries"),
        (["early"], "early: no epoch has ended yet"),
        (["run", "out=taken/page.html"], "out=taken/page.html: cannot be written"),
        (["run", "output=x"], "unknown key 'output' (did you mean 'out'?)"),
    ],
)
def test_a_mistake_is_one_line(words, message, make_run, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    make_run(AMP).rename("run")
    make_run({"info/some": [1.0]}).rename("early")
    Path("empty").mkdir()
    Path("bare/summaries").mkdir(parents=True)
    Path("taken").touch()
    with pytest.raises(SystemExit) as caught:
        main(words)
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {message}")
    assert error.count("\n") == 1


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
# Moves the pointer over the first chart and keeps what the page says then.
POINTER = """<script>
const svg = document.querySelector("svg"), box = svg.getBoundingClientRect();
svg.dispatchEvent(new PointerEvent("pointermove", {clientX: box.left + box.width / 2}));
document.title = [document.querySelector("output").textContent, box.width > 300,
  getComputedStyle(document.querySelector("polyline")).stroke,
  document.querySelector("details").open].join("|");
</script></body>"""


@pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's package chromium")
@pytest.mark.parametrize("dark", [False, True])
def test_chromium_shows_curves_and_the_values_under_the_pointer(dark, make_run, tmp_path) -> None:
    path = write_report(make_run(AMP))
    path.write_text(path.read_text().replace("</body>", POINTER))
    command = [
        *(str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic"),
        *("--no-first-run", "--disable-background-networking", "--disable-component-update"),
        *("--disable-sync", f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1200,900"),
        *(["--force-dark-mode"] if dark else []),
        *("--dump-dom", path.as_uri()),
    ]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    title = re.search(r"<title>(.*?)</title>", result.stdout, re.DOTALL)
    assert title is not None, result.stderr
    values, wide, stroke, is_open = title[1].split("|")
    assert values.split("\n") == ["100 frames, 2 min", "task reward: 20"]
    assert (wide, is_open) == ("true", "false")
    assert stroke == ("rgb(125, 177, 255)" if dark else "rgb(31, 95, 191)")
