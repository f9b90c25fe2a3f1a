"""Writes videos of robots, without a display and without the system's ffmpeg.

    images = draw_tracks(env.simulation.model, tracks, labels=("reference", "policy"))
    save_video("walk.mp4", images, fps=1.0 / env.dt)

PyAV encodes the pictures one by one in this process; its wheel includes FFmpeg's libraries.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import mujoco
import numpy as np

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.rendering.markers import Marker
from isaacgymenvs_lite.rendering.scene import Image, SceneRenderer, Track
from isaacgymenvs_lite.rendering.view import View
from isaacgymenvs_lite.utils.optional_packages import import_package, require

PANEL_WIDTH, PANEL_HEIGHT = 320, 480
"""Size of a track's panel in pixels."""

# Maps each suffix to the encoder, the encoder's options and the container's options. With crf 20,
# H.264 looks like the original. Animated WebP is for pages that cannot show videos, like a README.
_FORMATS: dict[str, tuple[str, dict[str, str], dict[str, str]]] = {
    ".mp4": ("libx264", {"crf": "20", "preset": "veryfast"}, {"movflags": "+faststart"}),
    ".webp": ("libwebp_anim", {"quality": "60"}, {"loop": "0"}),
}
_ENCODER, _PURPOSE = "av", "writing videos"
_PIXEL_FORMAT = "yuv420p"  # All players and browsers support this format.


def check_encoder() -> None:
    """Check that videos can be encoded.

    Raises:
        MissingPackageError: PyAV is not installed.
    """
    require(_ENCODER, _PURPOSE)


def draw_tracks(
    model: mujoco.MjModel,
    tracks: Sequence[Track],
    labels: Sequence[str] = (),
    *,
    markers: Sequence[Sequence[Sequence[Marker]]] = (),
    width: int = PANEL_WIDTH,
    height: int = PANEL_HEIGHT,
    fast: bool = True,
    columns: int | None = None,
    view: View | None = None,
    follow: bool = True,
) -> Iterator[Image]:
    """Draw tracks (T, nq) in panels with their own cameras, until the shortest track ends.

    The generator yields a picture (rows * height, columns * width, 3) for each time; unused panels
    are black. `markers` has the markers of each time and panel. If `follow` is False, each camera
    stays at its robot's first position.
    """
    labels = labels or [""] * len(tracks)
    columns = columns or len(tracks)
    black = np.zeros((height, width, 3), np.uint8)
    with SceneRenderer(model, width, height, view=view, fast=fast) as renderer:
        nothing = [()] * len(tracks)
        times = markers or itertools.repeat(nothing)
        for poses, beside in zip(zip(*tracks, strict=False), times, strict=False):
            places = poses if follow else [track[0] for track in tracks]
            panels = zip(poses, labels, beside, places, strict=True)
            pictures = [renderer.draw(*panel) for panel in panels]
            pictures += [black] * (-len(pictures) % columns)
            rows = [
                np.concatenate(pictures[first : first + columns], axis=1)
                for first in range(0, len(pictures), columns)
            ]
            yield np.concatenate(rows)


def save_video(path: str | Path, images: Iterable[Image], fps: float) -> Path:
    """Write pictures (height, width, 3) as .mp4 or .webp; return the path.

    All pictures must have the same even height and the same even width. If there are no pictures,
    no file is written.
    """
    path = Path(path)
    if path.suffix not in _FORMATS:
        raise ConfigError(unknown("video format", path.suffix, _FORMATS))
    av = import_package(_ENCODER, _PURPOSE)
    encoder, options, container_options = _FORMATS[path.suffix]
    is_written = False
    try:
        with av.open(str(path), "w", options=container_options) as container:
            rate = Fraction(fps).limit_denominator(1000)
            stream = container.add_stream(encoder, rate=rate, options=options)
            stream.pix_fmt = _PIXEL_FORMAT
            for image in images:
                if not is_written:
                    stream.height, stream.width = image.shape[:2]
                is_written = True
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
                container.mux(stream.encode(frame))
            if is_written:
                container.mux(stream.encode(None))  # writes the remaining packets
    except OSError as error:
        is_written = False
        raise ConfigError(
            f"cannot write the video {path.absolute()} ({error.strerror}); expected an existing"
            " folder that can be written and has space"
        ) from error
    finally:
        if not is_written:
            path.unlink(missing_ok=True)
    return path
