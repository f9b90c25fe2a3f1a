from __future__ import annotations

import importlib.util
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from isaacgymenvs_lite import wrappers
from isaacgymenvs_lite.errors import MissingPackageError
from isaacgymenvs_lite.utils import optional_packages

LIBRARIES = {
    "Sb3VecEnvWrapper": ("stable_baselines3", "sb3"),
    "SkrlVecEnvWrapper": ("skrl", "skrl"),
    "RslRlVecEnvWrapper": ("rsl_rl", "rsl-rl"),
}


def test_the_package_imports_no_library():
    code = (
        "import sys, isaacgymenvs_lite.wrappers\n"
        "print(*({'stable_baselines3', 'skrl', 'rsl_rl', 'rl_games', 'torch'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not done.stdout.strip()


@pytest.mark.parametrize("name", sorted(LIBRARIES))
def test_a_library_that_is_not_installed_is_named_with_its_extra(name, monkeypatch):
    package, extra = LIBRARIES[name]
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda module, find=importlib.util.find_spec: None
    )
    with pytest.raises(MissingPackageError) as caught:
        getattr(wrappers, name)
    assert str(caught.value) == (
        f"{name} needs the package {package}, which is not installed;"
        f' pip install "isaacgymenvs-lite[{extra}]"'
    )


def test_every_extra_is_one_of_the_package():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert set(optional_packages.EXTRAS.values()) <= project["optional-dependencies"].keys()


@pytest.mark.parametrize("name", ["GymnasiumEnv", "GymnasiumVectorEnv", "RLGPUEnv"])
def test_the_others_are_always_there(name):
    assert name in dir(wrappers)
    assert getattr(wrappers, name).__name__ == name


def test_another_name_is_no_attribute():
    with pytest.raises(AttributeError, match="no attribute 'TianshouWrapper'"):
        _ = wrappers.TianshouWrapper
