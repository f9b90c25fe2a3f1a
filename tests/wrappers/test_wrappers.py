from __future__ import annotations

import importlib.util
import subprocess
import sys

import pytest

from isaacgymenvs_lite import wrappers
from isaacgymenvs_lite.errors import MissingPackageError

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


def test_a_library_that_is_not_installed_is_named_with_its_extra(monkeypatch):
    for name in sorted(LIBRARIES):
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
