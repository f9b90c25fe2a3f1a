"""Whether there is a display to open a window on."""

from __future__ import annotations

import importlib
import warnings

from isaacgymenvs_lite.errors import ConfigError

_INSTEAD = "headless=True with viewer=web for a browser, or with capture_video=True for videos"


def check_display(asked: str = "headless=False", instead: str = _INSTEAD) -> None:
    """Say at once that there is no display, or nothing to open a window with.

    Args:
        asked: what wants the window.
        instead: what works without one.

    Raises:
        ConfigError: so it is.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW's reason why not
            shown = bool(importlib.import_module("glfw").init())
    except Exception as error:  # the library behind it may be missing in many ways
        raise ConfigError(
            f"{asked}: no window can be opened here ({error}); without one: {instead}"
        ) from error
    if not shown:
        raise ConfigError(
            f"{asked}: there is no display (DISPLAY is not set?); without one: {instead}"
        )
