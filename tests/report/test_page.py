"""The page of a run: what is on it, and what files of a stranger's run may do."""

from __future__ import annotations

import base64
import os
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from isaacgymenvs_lite.report import page as page_module
from isaacgymenvs_lite.report.__main__ import main
from isaacgymenvs_lite.report.page import charts_of, write_report
from isaacgymenvs_lite.report.scalars import read_scalars
from tests.report.conftest import AMP, CONFIG, FEW


class Page(HTMLParser):
    """What a page consists of."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.charts: dict[str, bytes] = {}
        self.videos: list[str] = []
        self.facts: dict[str, str] = {}
        self.config = ""
        self._open, self._name = "", ""
        self.feed(path.read_text(encoding="utf-8"))
        self.close()

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self._open = tag
        if tag == "img":
            self.charts[values["alt"]] = base64.b64decode(values["src"].split(",")[1])
        elif tag == "video":
            self.videos.append(values["src"])

    def handle_endtag(self, tag):
        self._open = ""

    def handle_data(self, data):
        if self._open == "dt":
            self._name = data
        elif self._open == "dd":
            self.facts[self._name] = data
        elif self._open == "pre":
            self.config += data


def test_a_run_on_one_page(make_run) -> None:
    run = make_run(AMP)
    path = write_report(run)
    assert path == run / "report.html"
    page = Page(path)
    assert page.facts == {
        "task": "HumanoidAMP",
        "algorithm": "amp_agent",
        "frames": "200",
        "minutes trained": "3.0",
        "frames per second": "110",
        "task reward of an episode": "30",
        "steps of an episode": "60",
        "style reward per step": "0.750",
        "pose error": "0.062 m",
        "falls in training": "25%",
        "off the clip": "20%",
        "learning rate": "5e-05",
    }
    assert page.config == CONFIG
    assert len(page.charts) == 10
    assert all(picture.startswith(b"\x89PNG") for picture in page.charts.values())
    assert not re.search(r"https?:|//cdn|@import|url\(", path.read_text())


def test_charts_have_the_scalars_that_the_run_has(make_run) -> None:
    charts = charts_of(read_scalars(make_run(AMP) / "summaries"))
    assert list(charts["Discriminator accuracy"]) == ["policy", "clips"]
    assert list(charts["Losses"]) == ["a_loss", "disc_loss"]
    assert charts["Pose error, m"]["mean policy"].values.tolist() == [0.25, 0.125, 0.0625]


def test_successes_of_episodes(make_run) -> None:
    rates = {"success/at_goal": [0.1, 0.25], "success/measured_at_goal": [0.2, 0.5]}
    run = make_run({**FEW, **rates})
    chart = charts_of(read_scalars(run / "summaries"))["Success of an episode"]
    assert list(chart) == ["at_goal", "measured_at_goal"]
    page = Page(write_report(run))
    assert "Success of an episode" in page.charts
    assert (page.facts["at goal"], page.facts["measured at goal"]) == ("0.25", "0.5")


@pytest.mark.parametrize("config", ["task: [", "[" * 5000])
def test_a_damaged_configuration_is_shown_as_it_is(config, make_run) -> None:
    assert Page(write_report(make_run(FEW, config=config))).config == config


def add_video(run: Path, name: str, content: bytes, mtime: int) -> None:
    file = run / "videos" / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content)
    os.utime(file, (mtime, mtime))


def test_the_last_video_is_embedded_unless_it_is_large(make_run, monkeypatch) -> None:
    run = make_run(FEW)
    add_video(run, "step-200.mp4", b"newer", 2000)
    add_video(run, "step-0.mp4", b"older", 1000)
    (source,) = Page(write_report(run)).videos
    assert base64.b64decode(source.removeprefix("data:video/mp4;base64,")) == b"newer"
    monkeypatch.setattr(page_module, "MAX_VIDEO_BYTES", 3)
    path = write_report(run)
    assert Page(path).videos == []
    assert "videos/step-200.mp4" in path.read_text()


HOSTILE = "<!--<script>alert(1)<img src=x onerror=alert(2)>'\"$\\frac"


def test_names_and_texts_of_files_are_no_html(make_run) -> None:
    config = f"# {HOSTILE}</pre></script><script>alert(3)</script>\n"
    run = make_run({**FEW, f"losses/{HOSTILE}": [1.0, 2.0]}, config=config, name=HOSTILE)
    add_video(run, f"{HOSTILE}\udcff.mp4", b"video", 1000)  # with a byte that is no UTF-8
    path = write_report(run)
    page, text = Page(path), path.read_text(encoding="utf-8")
    assert page.config == config
    assert len(page.videos) == 1
    assert not re.search(r"<!--|<img src=x|<script>", text)


@pytest.mark.parametrize("kind", ["link", "linked folder", "pipe", "folder"])
def test_files_outside_of_the_run_are_not_on_its_page(kind, make_run, tmp_path) -> None:
    """A run of somebody else may have a link to a file of the user, who then shows the page."""
    (tmp_path / "secret").mkdir()
    secret = tmp_path / "secret" / "secret.mp4"
    secret.write_text("secret of the user")
    run = make_run(FEW, config="")
    videos = run / "videos"
    if kind == "linked folder":
        videos.symlink_to(secret.parent)
        files = []
    else:
        videos.mkdir()
        files = [run / "videos/a.mp4", run / "config.yaml"]
    for file in files:
        if kind == "pipe":
            os.mkfifo(file)
        elif kind == "folder":
            file.mkdir()
        else:
            file.symlink_to(secret)
    page = Page(write_report(run))
    assert (page.videos, page.config) == ([], "")


def test_the_command(make_run, tmp_path, caplog) -> None:
    run = make_run(AMP, name="a=b")
    with caplog.at_level("INFO"):
        assert main([str(run), f"out={tmp_path}/deep/page.html"]) == 0
    assert Page(tmp_path / "deep" / "page.html").facts["task"] == "HumanoidAMP"
    assert f"{tmp_path}/deep/page.html: 0." in caplog.text


def test_a_mistake_is_one_line(make_run, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    make_run(AMP).rename("run")
    make_run({"info/some": [1.0]}).rename("early")
    Path("taken").touch()
    for words, message in [
        (["absent"], "absent: no event files in its folder summaries; expected the folder of a"),
        (["early"], "early: no epoch has ended yet"),
        (["run", "out=taken/page.html"], "out=taken/page.html: cannot be written"),
        (["run", "output=x"], "unknown key 'output' (did you mean 'out'?)"),
    ]:
        with pytest.raises(SystemExit) as caught:
            main(words)
        assert caught.value.code == 2
        error = capsys.readouterr().err
        assert error.startswith(f"error: {message}")
        assert error.count("\n") == 1
