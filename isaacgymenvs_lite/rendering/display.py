"""Checks that a window can be opened on this machine."""

from __future__ import annotations

import importlib
import warnings

from isaacgymenvs_lite.errors import ConfigError

_INSTEAD = "headless=True with viewer=web for a browser, or with capture_video=True for videos"


def check_display(setting: str = "headless=False", instead: str = _INSTEAD) -> None:
    """Check that a window can be opened.

    Raises:
        ConfigError: no window can be opened; the message proposes `instead`.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW warns if no window can be opened.
            shown = bool(importlib.import_module("glfw").init())
    except Exception as error:  # A missing GLFW library raises errors of many types.
        raise ConfigError(
            f"{setting}: no window can be opened here ({error}); without one: {instead}"
        ) from error
    if not shown:
        raise ConfigError(
            f"{setting}: there is no display (DISPLAY is not set?); without one: {instead}"
        )
