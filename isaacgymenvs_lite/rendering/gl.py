"""Chooses an OpenGL library that draws without a screen.

MuJoCo reads the environment variable MUJOCO_GL when MuJoCo is imported; the default OpenGL library
needs a screen. `ensure_gl` chooses another library before the first picture is drawn, so that users
need not set the variable.
"""

from __future__ import annotations

import functools
import importlib
import logging
import os
import platform
import sys

import mujoco

from isaacgymenvs_lite.errors import UserError

log = logging.getLogger(__name__)

# Libraries that render without a screen on Linux, in the order in which `ensure_gl` tries them. EGL
# uses the GPU or Mesa's drivers, and OSMesa renders in software.
_BACKENDS = ("egl", "osmesa")
_PLATFORM_VARIABLE = "PYOPENGL_PLATFORM"
GL_MODULES = ("OpenGL", "mujoco.egl", "mujoco.osmesa")


class RenderingError(UserError, RuntimeError):
    """This machine cannot draw pictures."""


@functools.cache
def ensure_gl() -> str:
    """Choose a library with which MuJoCo draws without a screen, and return its name.

    If the environment contains MUJOCO_GL, its value is used. Otherwise EGL is tried, then OSMesa,
    and MUJOCO_GL is set to the library that works. On systems that are not Linux, MuJoCo's default
    is kept.

    Raises:
        RenderingError: no library works; the message names the Debian packages.
    """
    logging.getLogger("OpenGL").setLevel(logging.WARNING)  # hides details of the installation
    given = os.environ.get("MUJOCO_GL", "")
    candidates = _BACKENDS if platform.system() == "Linux" and not given else (given,)
    reasons = []
    for name in candidates:
        platform_before = os.environ.get(_PLATFORM_VARIABLE)
        try:
            try_backend(name)
        except Exception as error:  # Missing or broken libraries raise errors of many types.
            reasons.append(f"{name or 'default'}: {' '.join(str(error).split())}")
            log.debug("MUJOCO_GL=%s does not work", name, exc_info=True)
            _forget_backend(platform_before)
        else:
            log.debug("rendering with MUJOCO_GL=%s", name)
            return name
    _set_or_remove("MUJOCO_GL", given or None)
    raise RenderingError(_advice(given, reasons))


def try_backend(name: str) -> None:
    """Choose an OpenGL library, draw a picture with it, and pass on all errors of the library."""
    from mujoco.rendering.classic import gl_context

    if name:
        os.environ["MUJOCO_GL"] = name  # MuJoCo's C code also reads this variable.
        importlib.reload(gl_context)
    renderer = mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8)
    renderer.render()
    renderer.close()


def _forget_backend(platform_before: str | None) -> None:
    """Remove PyOpenGL's imported modules, because they are bound to one OpenGL library."""
    for module in list(sys.modules):
        if any(module == name or module.startswith(f"{name}.") for name in GL_MODULES):
            del sys.modules[module]
    _set_or_remove(_PLATFORM_VARIABLE, platform_before)


def _set_or_remove(variable: str, value: str | None) -> None:
    if value is None:
        os.environ.pop(variable, None)
    else:
        os.environ[variable] = value


def _advice(given: str, reasons: list[str]) -> str:
    tried = "; ".join(reasons)
    if given:
        return (
            f"MUJOCO_GL={given} cannot render here ({tried}); unset it to try EGL and OSMesa, or"
            " set it to egl or osmesa"
        )
    return (
        f"pictures and videos need an OpenGL library that works without a screen ({tried}); on"
        " Debian or Ubuntu: apt-get install libegl1 libgl1-mesa-dri, or libosmesa6"
    )
