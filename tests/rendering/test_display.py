from __future__ import annotations

import pytest

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering import display
from isaacgymenvs_lite.rendering.display import check_display


@pytest.mark.parametrize("reason", ["no display", "no library"])
def test_without_a_display_there_is_one_line(reason, monkeypatch):
    class Glfw:
        @staticmethod
        def init() -> bool:
            return False

    def import_module(name: str) -> type:
        if reason == "no library":
            raise ImportError("libglfw.so.3")
        return Glfw

    monkeypatch.setattr(display.importlib, "import_module", import_module)
    with pytest.raises(ConfigError, match=r"headless=False: .*viewer=web") as caught:
        check_display()
    assert "\n" not in str(caught.value)
