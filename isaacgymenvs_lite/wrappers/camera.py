"""The pictures that environments of other libraries return from `render`."""

from __future__ import annotations

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.rendering.tracks import TaskCamera

__all__ = ["RENDER_MODE", "TaskCamera", "checked_render_mode"]

RENDER_MODE = "rgb_array"


def checked_render_mode(render_mode: str | None) -> str | None:
    """Return a render mode that there is: `rgb_array`, or None for no pictures.

    Raises:
        ConfigError: another one.
    """
    if render_mode not in (None, RENDER_MODE):
        raise ConfigError(unknown("render_mode", render_mode, [RENDER_MODE, "None"]))
    return render_mode
