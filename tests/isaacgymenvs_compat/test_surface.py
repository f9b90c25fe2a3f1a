"""The published modules and names, one by one, in a process of the alias."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from isaacgymenvs_lite.isaacgymenvs_compat.module_names import (
    ABSENT,
    RENAMED,
    STAND_INS,
    absent_because,
)

_ROOT = Path(__file__).parents[2]
_MIGRATION = (_ROOT / "docs" / "migration.md").read_text(encoding="utf-8")

# What is found of each name and module, as JSON: a module's names, or why it cannot be imported.
_WALK = """
import importlib, json, sys
from isaacgymenvs_lite.commands import alias
alias.install()
found = {}
for module in json.load(sys.stdin):
    name = "isaacgymenvs" + ("." + module if module else "")
    try:
        found[module] = dir(importlib.import_module(name)), hasattr(sys.modules[name], "AnyName")
    except ModuleNotFoundError as error:
        found[module] = str(error)
json.dump(found, sys.stdout)
"""


def _surface() -> ModuleType:
    spec = importlib.util.spec_from_file_location("surface", Path(__file__).with_name("surface.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SURFACE = _surface()
PUBLISHED = {module: names.split() for module, names in SURFACE.NAMES.items()}


@pytest.fixture(scope="module")
def found() -> dict:
    modules = json.dumps([*PUBLISHED, *SURFACE.MODULES])
    done = subprocess.run(
        [sys.executable, "-c", _WALK], input=modules, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_every_published_name_is_there_or_on_the_list(found) -> None:
    for module, names in PUBLISHED.items():
        assert not isinstance(found[module], str), found[module]
        here, has_every_name = found[module]
        for name in names:
            absent = f"{module}.{name}" in SURFACE.ABSENT
            assert (name in here or has_every_name) != absent, f"{module}.{name}"


def test_modules_that_are_not_here_say_why(found) -> None:
    for module in SURFACE.MODULES:
        reason = absent_because(module)
        if reason is None:
            assert module.startswith(tuple(STAND_INS)), module
            assert not isinstance(found[module], str)
            continue
        name, _, rest = found[module].partition(": ")  # of the module, or of one above it
        assert f"isaacgymenvs.{module}.".startswith(f"{name}.")
        assert rest == (
            f"{reason}; docs/migration.md lists the replacements of IsaacGymEnvs' modules"
        )


def test_the_lists_name_what_is_published() -> None:
    everything = {f"{module}.{name}" for module, names in PUBLISHED.items() for name in names}
    assert set(SURFACE.OTHER) | set(SURFACE.ABSENT) <= everything
    assert not set(SURFACE.OTHER) & set(SURFACE.ABSENT)
    modules = [*PUBLISHED, *SURFACE.MODULES]
    for name in (*ABSENT, *STAND_INS, *RENAMED):
        assert any(f"{module}.".startswith(f"{name}.") for module in modules), name


def test_the_page_lists_the_modules_as_the_errors_promise() -> None:
    for name in (*ABSENT, *STAND_INS, *RENAMED):
        assert f"`{name}`" in _MIGRATION, name
