"""Markers: shapes that a picture shows beside robots, such as an arrow in the target direction."""

from __future__ import annotations

from dataclasses import dataclass

Point = tuple[float, float, float]
"""m, world."""
Colour = tuple[float, float, float]
"""Red, green, blue, 0 to 1."""

# Unlike anything in the scenes of the humanoids, whose ground is grey and sky is blue.
GO_COLOUR: Colour = (0.9, 0.15, 0.1)
FACE_COLOUR: Colour = (1.0, 0.8, 0.1)
ACTUAL_COLOUR: Colour = (0.1, 0.7, 0.2)


@dataclass(frozen=True)
class Arrow:
    """An arrow from one point to another."""

    start_w: Point
    end_w: Point
    colour: Colour


@dataclass(frozen=True)
class Sphere:
    """A sphere about a point."""

    centre_w: Point
    radius_m: float
    colour: Colour


Marker = Arrow | Sphere


def arrow_on_ground(
    xy_w: tuple[float, float], direction: tuple[float, float], colour: Colour
) -> Arrow:
    """Return an arrow just above the ground that starts beside a character.

    Args:
        xy_w: m, where the character is.
        direction: unit vector of the target direction.
        colour: of the arrow.
    """
    (x, y), (dx, dy) = xy_w, direction
    near, far, height = 0.3, 1.0, 0.03
    return Arrow(
        (x + near * dx, y + near * dy, height), (x + far * dx, y + far * dy, height), colour
    )
