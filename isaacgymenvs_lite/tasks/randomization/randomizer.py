"""DomainRandomizer: draws noise and physical parameters at the times that IsaacGymEnvs does.

Fixed in comparison (as named in docs/migration.md): each property and environment keeps the
original value that draws start from; `setup_only` concerns its own attribute alone; draws outside
the buckets go to the nearest one.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from isaacgymenvs_lite.simulation.backend import SimulationBackend
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.tasks.randomization.properties import Property, make_property
from isaacgymenvs_lite.tasks.randomization.sampling import Noise, draw
from isaacgymenvs_lite.tasks.randomization.settings import AttributeSettings, read_plan
from isaacgymenvs_lite.utils.state import Stateful

log = logging.getLogger(__name__)


class DomainRandomizer(Stateful):
    """Draws noise and models; everything once when it is made.

    Args:
        params: the section `task.task.randomization_params`.
        simulation: its models are made to differ.
        layout: of its model.
        actors: names of the task's actors, the robot's first.

    Raises:
        ConfigError: an unknown actor, property, attribute or value.
    """

    stored = ("_last_draw", "_action_noise", "_observation_noise")

    def __init__(
        self,
        params: Mapping[str, Any],
        simulation: SimulationBackend,
        layout: ModelLayout,
        actors: Collection[str],
    ) -> None:
        self._plan = plan = read_plan(params, actors)
        self._simulation = simulation
        self._action_noise = Noise(plan.actions) if plan.actions else None
        self._observation_noise = Noise(plan.observations) if plan.observations else None
        self._properties: list[tuple[AttributeSettings, Property]] = []
        unsupported = list(plan.unsupported)
        for (group, attribute), settings in plan.actor.items():
            found = make_property(simulation, layout, group, attribute)
            path = f"actor_params.{next(iter(actors))}.{group}.{attribute}"
            if found is None:
                unsupported.append(path)
                continue
            if found.left_out:
                unsupported.append(f"{path} of {found.left_out}")
            self._properties.append((settings, found))
        if unsupported:
            log.warning(
                "randomization_params: MuJoCo has no counterpart for %s; not randomised",
                ", ".join(unsupported),
            )
        self._gravity = simulation.expand("opt.gravity") if plan.gravity else None
        self._original_gravity = simulation.model.opt.gravity.copy()
        self._colours = simulation.expand("geom_rgba") if plan.colour else None
        self._robot_geoms = np.flatnonzero(simulation.model.geom_bodyid > 0)
        self._last_draw = 0
        everywhere = np.arange(simulation.num_envs)
        self._draw_common(frame=0)
        self._draw_environments(everywhere, frame=0, setup=True)

    def noisy_actions(self, actions: Tensor) -> Tensor:
        """Return actions (N, A) with noise, if there is any."""
        return actions if self._action_noise is None else self._action_noise(actions)

    def noisy_observations(self, observations: Tensor) -> Tensor:
        """Return observations (N, O) with noise, if there is any."""
        if self._observation_noise is None:
            return observations
        return self._observation_noise(observations)

    def on_reset(self, env_ids: Tensor, steps_since_draw: Tensor, frame: int) -> None:
        """Draw new values of what is due.

        Args:
            env_ids: (n,) environments that start a new episode.
            steps_since_draw: (N,) control steps since the last draw of each environment; set to
                zero where it is drawn.
            frame: simulator calls so far.
        """
        if frame - self._last_draw >= self._plan.frequency:
            self._last_draw = frame
            self._draw_common(frame)
        due = env_ids[steps_since_draw[env_ids] >= self._plan.frequency]
        if len(due) > 0:
            steps_since_draw.index_fill_(0, due, 0)
            self._draw_environments(due.cpu().numpy(), frame, setup=False)

    def _draw_common(self, frame: int) -> None:
        for noise in (self._action_noise, self._observation_noise):
            if noise is not None:
                noise.refresh(frame)
        if self._plan.gravity is not None and self._gravity is not None:
            drawn = draw(self._plan.gravity, frame, (3,)).numpy()
            self._gravity[:] = _applied(self._plan.gravity, self._original_gravity, drawn)

    def _draw_environments(self, rows: np.ndarray, frame: int, setup: bool) -> None:
        derived = False
        for settings, attribute in self._properties:
            if settings.setup_only and not setup:
                continue
            drawn = draw(settings, frame, (len(rows), len(attribute.original))).numpy()
            attribute.write(rows, _applied(settings, attribute.original, drawn))
            derived = derived or attribute.changes_constants
        if self._colours is not None:
            colours = torch.rand(len(rows), len(self._robot_geoms), 3).numpy()
            self._colours[np.ix_(rows, self._robot_geoms, np.arange(3))] = colours
        if derived:
            self._simulation.update_constants(rows)


def _applied(settings: AttributeSettings, original: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    return original + drawn if settings.operation == "additive" else original * drawn
