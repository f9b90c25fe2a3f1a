"""A headless Chromium, controlled over its debugging port."""

from __future__ import annotations

import base64
import io
import itertools
import json
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
from websockets.sync.client import connect

CHROMIUM = shutil.which("chromium")
_OPTIONS = (
    *("--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--window-size=640,480"),
    # WebGL without a GPU
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    "--remote-debugging-port=0",
)
_TIMEOUT_S = 30.0


class Browser:
    """Chromium with one page. Use it in a `with` statement."""

    def __init__(self, profile: Path, url: str) -> None:
        assert CHROMIUM is not None
        self._process = subprocess.Popen(
            [CHROMIUM, *_OPTIONS, f"--user-data-dir={profile}", url],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            self._page = connect(self._debugging_url(profile), max_size=None)
        except BaseException:
            self._process.kill()
            raise
        self._ids = itertools.count(1)

    def _debugging_url(self, profile: Path) -> str:
        port_file, end_s = profile / "DevToolsActivePort", time.monotonic() + _TIMEOUT_S
        while time.monotonic() < end_s:
            if port_file.exists() and (lines := port_file.read_text().split()):
                with urllib.request.urlopen(f"http://127.0.0.1:{lines[0]}/json") as answer:
                    pages = [page for page in json.load(answer) if page["type"] == "page"]
                if pages:
                    return pages[0]["webSocketDebuggerUrl"]
            time.sleep(0.1)
        raise TimeoutError("Chromium did not start")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the debugging protocol and return its result."""
        number = next(self._ids)
        self._page.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._page.recv(timeout=_TIMEOUT_S))
            if answer.get("id") == number:
                return answer.get("result", {})

    def screenshot(self) -> np.ndarray:
        """Return what the page shows, (height, width, 3)."""
        data = base64.b64decode(self.call("Page.captureScreenshot")["data"])
        return np.array(PIL.Image.open(io.BytesIO(data)).convert("RGB"))

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._page.close()
        self._process.terminate()
        self._process.wait(timeout=_TIMEOUT_S)
