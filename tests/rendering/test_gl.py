from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import isaacgymenvs_lite
from isaacgymenvs_lite.rendering import gl as gl_module
from isaacgymenvs_lite.rendering.gl import RenderingError, ensure_gl

CODE = """
import mujoco  # as a training has imported it long before
from isaacgymenvs_lite.rendering.gl import RenderingError, ensure_gl
try:
    print(ensure_gl())
except RenderingError as error:
    print("refused:", error)
"""


def choose(**environment: str) -> str:
    """Return the output of a new process: PyOpenGL can be bound to a library once only."""
    package = str(Path(isaacgymenvs_lite.__file__).parents[1])
    cleared = ("MUJOCO_GL", "PYOPENGL_PLATFORM")
    inherited = {name: value for name, value in os.environ.items() if name not in cleared}
    result = subprocess.run(
        [sys.executable, "-c", CODE],
        env={**inherited, "PYTHONPATH": package, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.stdout, result.stderr
    return result.stdout.strip()


def test_mujoco_may_be_imported_before_the_choice(gl):
    assert choose() == gl


def test_without_any_library_the_error_names_the_packages():
    """A platform of PyOpenGL that neither EGL nor OSMesa can use."""
    message = choose(PYOPENGL_PLATFORM="glx")
    assert message.startswith("refused: ")
    assert "\n" not in message
    for words in ("libegl1", "libosmesa6", "egl:", "osmesa:"):
        assert words in message


def test_what_the_user_has_chosen_is_not_replaced():
    message = choose(MUJOCO_GL="osmesa", PYOPENGL_PLATFORM="egl")
    assert message.startswith("refused: MUJOCO_GL=osmesa cannot render here")
    assert "unset it" in message


@pytest.fixture
def unchosen(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(gl_module.platform, "system", lambda: "Linux")
    # not the modules that other tests draw with
    monkeypatch.setattr(gl_module, "GL_MODULES", ())
    return monkeypatch


def test_osmesa_comes_after_egl(unchosen):
    tried = []

    def attempt(name: str) -> None:
        tried.append(name)
        os.environ["PYOPENGL_PLATFORM"] = name
        if name == "egl":
            raise ImportError("no EGL device")

    unchosen.setenv("PYOPENGL_PLATFORM", "")
    unchosen.setattr(gl_module, "try_backend", attempt)
    assert ensure_gl.__wrapped__() == "osmesa"
    assert tried == ["egl", "osmesa"]


def test_a_failure_leaves_the_environment_as_it_was(unchosen):
    def attempt(name: str) -> None:
        os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = name
        raise AttributeError("'NoneType' object\nhas no attribute")

    unchosen.delenv("PYOPENGL_PLATFORM", raising=False)
    unchosen.setattr(gl_module, "try_backend", attempt)
    with pytest.raises(RenderingError, match="apt-get install") as caught:
        ensure_gl.__wrapped__()
    assert "\n" not in str(caught.value)
    assert "MUJOCO_GL" not in os.environ
    assert "PYOPENGL_PLATFORM" not in os.environ
