"""DomainRandomizer: draws noise and physical parameters at the same times as IsaacGymEnvs.

docs/migration.md lists the differences. A draw always changes the original value of a property, not
the previously drawn value. `setup_only` affects only the attribute that contains it. A draw outside
the buckets uses the nearest bucket.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from isaacgymenvs_lite.simulation.backend import SimulationBackend
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.tasks.randomization.properties import (
    Property,
    bodies_of_actors,
    make_property,
)
from isaacgymenvs_lite.tasks.randomization.settings import (
    AttributeSettings,
    NoiseSettings,
    read_plan,
)
from isaacgymenvs_lite.utils.state import Stateful

log = logging.getLogger(__name__)


def draw(settings: AttributeSettings, frame: int, shape: tuple[int, ...]) -> Tensor:
    """Draw random float64 values of `shape` that are to be added to or multiplied with values.

    `frame` is the number of simulator calls so far, on which the schedule depends.
    """
    factor = settings.factor(frame)
    scaling = settings.operation == "scaling"
    first, second = settings.range
    rest = 1.0 - factor if scaling else 0.0  # weight of the original value
    if factor == 0.0:
        return torch.full(shape, rest, dtype=torch.float64)
    if settings.distribution == "gaussian":
        drawn = torch.randn(shape, dtype=torch.float64) * (factor * second) + factor * first + rest
    else:
        low, high = factor * first + rest, factor * second + rest
        share = torch.rand(shape, dtype=torch.float64)
        if settings.distribution == "uniform":
            drawn = low + (high - low) * share
        else:
            drawn = torch.exp(math.log(low) + (math.log(high) - math.log(low)) * share)
    return drawn if settings.num_buckets is None else bucketed(drawn, settings)


def bucketed(drawn: Tensor, settings: AttributeSettings) -> Tensor:
    """Round values down to the grid of buckets, clamp them to its range, and return them."""
    first, second = settings.range
    low, high = first, second
    if settings.distribution == "gaussian":
        # IsaacGymEnvs uses the standard deviation as a variance here.
        low, high = first - 2.0 * math.sqrt(second), first + 2.0 * math.sqrt(second)
    count = settings.num_buckets or 1
    width = (high - low) / count
    if width == 0.0:
        return torch.full_like(drawn, low)
    places = ((drawn - low) / width).floor().clamp(0, count - 1)
    return low + width * places


class Noise(Stateful):
    """Noise on values (N, D): new values in each call, and values that only `refresh` redraws."""

    def __init__(self, settings: NoiseSettings) -> None:
        self._settings = settings
        self._held: Tensor | None = None
        self.refresh(0)

    def refresh(self, frame: int) -> None:
        """Redraw the constant noise as scheduled after `frame` simulator calls."""
        settings = self._settings
        factor = settings.factor(frame)
        first, second = (factor * value for value in settings.range)
        held_first, held_second = (factor * value for value in settings.range_correlated)
        if settings.operation == "scaling":
            rest = 1.0 - factor
            first, held_first = first + rest, held_first + rest
            if settings.distribution == "uniform":
                second, held_second = second + rest, held_second + rest
        self._fresh = (first, second)
        self._correlated = (held_first, held_second)
        self._held = None

    def __call__(self, values: Tensor) -> Tensor:
        """Add noise to `values` (N, D), and return the sums."""
        if self._held is None:
            self._held = torch.randn_like(values)
        (first, second), (held_first, held_second) = self._fresh, self._correlated
        if self._settings.distribution == "gaussian":
            noise = self._held * held_second + held_first
            noise += torch.randn_like(values).mul_(second).add_(first)
        else:
            # As in IsaacGymEnvs, even uniform noise has a Gaussian constant part.
            noise = self._held * (held_second - held_first) + held_first
            noise += torch.rand_like(values).mul_(second - first).add_(first)
        return values + noise if self._settings.operation == "additive" else values * noise


class DomainRandomizer(Stateful):
    """Draws noise and model parameters, for the first time at construction.

    `params` is the section `task.task.randomization_params`. `actors` maps the name of each actor
    to the name of its first body; '' means all bodies except objects and other actors.

    Raises:
        ConfigError: an actor, property, attribute or value is invalid.
    """

    stored = ("_last_draw", "_action_noise", "_observation_noise")

    def __init__(
        self,
        params: Mapping[str, Any],
        simulation: SimulationBackend,
        layout: ModelLayout,
        actors: Mapping[str, str],
    ) -> None:
        self._plan = plan = read_plan(params, actors)
        self._simulation = simulation
        self._action_noise = Noise(plan.actions) if plan.actions else None
        self._observation_noise = Noise(plan.observations) if plan.observations else None
        self._properties: list[tuple[AttributeSettings, Property]] = []
        unsupported = list(plan.unsupported)
        bodies = bodies_of_actors(simulation.model, layout, actors)
        for (actor, group, attribute), settings in plan.actors.items():
            found = make_property(simulation, layout, bodies[actor], group, attribute)
            path = f"actor_params.{actor}.{group}.{attribute}".rstrip(".")
            if found is None:
                unsupported.append(path)
                continue
            if found.left_out:
                unsupported.append(f"{path} of {found.left_out}")
            self._properties.append((settings, found))
        if unsupported:
            log.warning(
                "randomization_params: not randomised, because MuJoCo has no counterpart: %s",
                ", ".join(unsupported),
            )
        self._gravity = simulation.expand("opt.gravity") if plan.gravity else None
        self._original_gravity = simulation.model.opt.gravity.copy()
        self._colours = simulation.expand("geom_rgba") if plan.coloured else None
        coloured = [body for actor in plan.coloured for body in bodies[actor]]
        self._coloured = np.flatnonzero(np.isin(simulation.model.geom_bodyid, coloured))
        self._last_draw = 0
        everywhere = np.arange(simulation.num_envs)
        self._draw_common(frame=0)
        self._draw_environments(everywhere, frame=0, setup=True)

    def noisy_actions(self, actions: Tensor) -> Tensor:
        """Return actions (N, A) with the configured noise, if any."""
        return actions if self._action_noise is None else self._action_noise(actions)

    def noisy_observations(self, observations: Tensor) -> Tensor:
        """Return observations (N, O) with the configured noise, if any."""
        if self._observation_noise is None:
            return observations
        return self._observation_noise(observations)

    def on_reset(self, env_ids: Tensor, steps_since_draw: Tensor, frame: int) -> None:
        """Draw the values that are due in environments (n,) at the start of an episode.

        `steps_since_draw` (N,) counts control steps since the last draw. The function sets it to 0
        where it draws values. `frame` is the number of simulator calls so far.
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
            colours = torch.rand(len(rows), len(self._coloured), 3).numpy()
            self._colours[np.ix_(rows, self._coloured, np.arange(3))] = colours
        if derived:
            self._simulation.update_constants(rows)


def _applied(settings: AttributeSettings, original: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    return original + drawn if settings.operation == "additive" else original * drawn
