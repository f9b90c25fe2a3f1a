"""Who looks on while a task is stepped: a recorder of videos, a window."""

from __future__ import annotations

from typing import Protocol


class StepListener(Protocol):
    """Added to `VecTask.listeners`; reads the task and changes nothing of it.

    One with a true attribute `keeps_playing` lets a play go on after its last episode.
    """

    def after_step(self) -> None:
        """Hear that a control step was made; episodes that it ended may not have begun anew."""
        ...

    def render(self) -> None:
        """Show the present state, because somebody asked the task to."""
        ...

    def close(self) -> None:
        """Finish what was begun; a second call does nothing."""
        ...
