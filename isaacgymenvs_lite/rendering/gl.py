"""The choice of an OpenGL library that draws without a screen.

MuJoCo reads the environment variable MUJOCO_GL when it is imported, and by default takes a library
that needs a screen. `ensure_gl` makes the choice later, before the first picture, so that no
variable has to be set before Python starts.
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

# Libraries that render without a screen on Linux, in the order of trying: EGL on the GPU or with
# Mesa's drivers, OSMesa in software only.
_BACKENDS = ("egl", "osmesa")
_PLATFORM_VARIABLE = "PYOPENGL_PLATFORM"
GL_MODULES = ("OpenGL", "mujoco.egl", "mujoco.osmesa")


class RenderingError(UserError, RuntimeError):
    """This machine cannot draw pictures."""


@functools.cache
def ensure_gl() -> str:
    """Choose a library for MuJoCo to draw without a screen, and return its name.

    A value of MUJOCO_GL in the environment is respected. Otherwise EGL is tried, then OSMesa,
    and MUJOCO_GL is set to the one that works. Off Linux MuJoCo's own choice is kept.

    Raises:
        RenderingError: none works; the message names the Debian packages.
    """
    logging.getLogger("OpenGL").setLevel(logging.WARNING)  # it logs its own installation
    given = os.environ.get("MUJOCO_GL", "")
    candidates = _BACKENDS if platform.system() == "Linux" and not given else (given,)
    reasons = []
    for name in candidates:
        platform_before = os.environ.get(_PLATFORM_VARIABLE)
        try:
            try_backend(name)
        except Exception as error:  # a library that is missing or broken raises all kinds
            reasons.append(f"{name or 'default'}: {' '.join(str(error).split())}")
            log.debug("MUJOCO_GL=%s does not work", name, exc_info=True)
            _forget_backend(platform_before)
        else:
            log.debug("rendering with MUJOCO_GL=%s", name)
            return name
    _set_or_remove("MUJOCO_GL", given or None)
    raise RenderingError(_advice(given, reasons))


def try_backend(name: str) -> None:
    """Choose a library and draw a picture with it; raises the library's errors."""
    from mujoco.rendering.classic import gl_context

    if name:
        os.environ["MUJOCO_GL"] = name  # MuJoCo's C code reads it, too
        importlib.reload(gl_context)
    renderer = mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8)
    renderer.render()
    renderer.close()


def _forget_backend(platform_before: str | None) -> None:
    """Undo the import of a library: PyOpenGL binds itself to one for the life of its modules."""
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
