"""`isaacgymenvs-lite check` without a file: does this installation work?"""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError
from types import SimpleNamespace

import pytest

from isaacgymenvs_lite import __version__
from isaacgymenvs_lite.commands import check, installation
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.gl import RenderingError


def rows() -> tuple[Mapping[str, str], bool]:
    lines, works = installation.describe_installation()
    return dict(line.split(":", 1) for line in lines[:-1]), works


def test_one_screen_describes_a_working_installation(capsys):
    assert check.main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 24
    assert lines[0].startswith(f"package:    isaacgymenvs_lite {__version__}, checkout ")
    assert lines[-1] == "a training can start"
    (physics,) = (line for line in lines if line.startswith("physics:"))
    assert re.search(r"makes [\d,]+ steps/s$", physics)
    (needs,) = (line for line in lines if line.startswith("needs:"))
    for name in ("mujoco 4.", "rl-games 1.6", "torch 2."):
        assert name in needs


@pytest.fixture
def quick(monkeypatch):
    """Without the rows that take seconds."""
    monkeypatch.setattr(installation, "measure_bfloat16_speedup", lambda: 2.0)
    monkeypatch.setattr(installation, "_NUM_STEPS", 1)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("requirement", "row"),
    [
        ("no-such-package>=1", r"no-such-package missing \(unfit\)"),
        ("numpy<1", r"numpy 2\S* \(unfit\)"),
    ],
)
def test_a_package_that_does_not_fit_ends_with_how_to_mend_it(monkeypatch, requirement, row):
    monkeypatch.setattr(installation, "requires", lambda _: [requirement, "moviepy; extra == 'x'"])
    found, works = rows()
    assert not works
    assert re.search(rf'{row}; pip install "{requirement}"$', found["needs"])
    assert "moviepy" not in found["needs"]


@pytest.mark.usefixtures("quick")
def test_a_checkout_that_is_not_installed_is_described_as_well(monkeypatch):
    def no_metadata(_: str) -> None:
        raise PackageNotFoundError

    monkeypatch.setattr(installation, "requires", no_metadata)
    found, works = rows()
    assert works
    assert "the package is not installed; pip install -e ." in found["needs"]


@pytest.mark.usefixtures("quick")
def test_what_a_training_can_do_without_is_said_and_no_mistake(monkeypatch):
    def no_pictures() -> str:
        raise RenderingError("no library draws")

    monkeypatch.setattr(installation, "ensure_gl", no_pictures)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=2**30))
    found, works = rows()
    assert works
    assert found["pictures"].strip() == "no library draws"
    assert found["disk"].endswith("a long run may need more")


@pytest.mark.usefixtures("quick")
def test_a_simulation_that_does_not_start_is_the_reason(monkeypatch):
    def broken(*_: object, **__: object) -> None:
        raise ConfigError("the model does not compile")

    monkeypatch.setattr(installation, "make_from_config", broken)
    found, works = rows()
    assert not works
    assert found["physics"].strip() == "the model does not compile"
    assert check.main([]) == 1
