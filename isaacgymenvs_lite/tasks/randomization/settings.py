"""Reads and checks the section `task.task.randomization_params`, with IsaacGymEnvs' keys."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.schema import read_section, setting

WHERE = "task.task.randomization_params"
_OPERATIONS = ("additive", "scaling")
_SCHEDULES = ("linear", "constant")

PROPERTIES: dict[str, tuple[str, ...]] = {
    "rigid_body_properties": ("mass", "invMass"),
    "rigid_shape_properties": (
        *("friction", "rolling_friction", "torsion_friction"),
        *("restitution", "compliance", "thickness"),
    ),
    "dof_properties": (
        *("lower", "upper", "velocity", "effort"),
        *("stiffness", "damping", "friction", "armature"),
    ),
    "tendon_properties": (
        *("stiffness", "damping", "fixed_spring_rest_length"),
        *("fixed_lower_limit", "fixed_upper_limit"),
    ),
}
"""Groups of an actor's properties, and their attributes."""
_SIM_PARAMS = ("gravity", "rest_offset")


@dataclass(frozen=True, kw_only=True)
class _Scheduled:
    range: tuple[float, ...] = setting(length=2)
    """Limits of a uniform distribution, or mean and standard deviation of a normal distribution."""
    operation: str = setting(choices=_OPERATIONS)
    schedule: str | None = setting(None, choices=_SCHEDULES)
    """Shape of the growth to full strength. None selects full strength from the start."""
    schedule_steps: int = setting(1, minimum=1)
    """Simulator calls until full strength."""

    def factor(self, frame: int) -> float:
        """Return the strength of the randomisation at `frame` simulator calls, 0 to 1."""
        if self.schedule is None:
            return 1.0
        if self.schedule == "constant":
            return 0.0 if frame < self.schedule_steps else 1.0
        return min(frame, self.schedule_steps) / self.schedule_steps


@dataclass(frozen=True, kw_only=True)
class AttributeSettings(_Scheduled):
    """Distribution of one attribute of the model."""

    distribution: str = setting(choices=("uniform", "loguniform", "gaussian"))
    setup_only: bool = setting(False)
    """Whether the attribute is drawn only once, when the simulation is created."""
    num_buckets: int | None = setting(None, minimum=1)
    """Draws are rounded down to a grid of this many values."""


@dataclass(frozen=True, kw_only=True)
class NoiseSettings(_Scheduled):
    """Noise on observations or actions in every step."""

    distribution: str = setting(choices=("uniform", "gaussian"))
    range_correlated: tuple[float, ...] = setting((0.0, 0.0), length=2)
    """The `range` of noise that stays constant until parameters are drawn again."""


@dataclass(frozen=True)
class RandomizationPlan:
    """The randomised quantities and the interval of their draws."""

    frequency: int
    """Simulator calls (noise, gravity) or control steps (actors) between draws."""
    observations: NoiseSettings | None
    actions: NoiseSettings | None
    gravity: AttributeSettings | None
    actors: dict[tuple[str, str, str], AttributeSettings] = field(default_factory=dict)
    """Maps (actor, group, attribute) to settings."""
    coloured: tuple[str, ...] = ()
    """The actors whose bodies get random colours."""
    unsupported: tuple[str, ...] = ()
    """Paths of entries without a counterpart in MuJoCo."""


def read_plan(params: Mapping[str, Any], actors: Collection[str]) -> RandomizationPlan:
    """Check and return `randomization_params` of a task with these `actors`.

    Raises:
        ConfigError: an actor, property, attribute, value or range is invalid.
    """
    known = ("frequency", "observations", "actions", "sim_params", "actor_params")
    _check_names(params, known, WHERE, "entry")
    sim = params.get("sim_params") or {}
    _check_names(sim, _SIM_PARAMS, f"{WHERE}.sim_params", "parameter")
    gravity = sim.get("gravity")
    unsupported = [f"sim_params.{key}" for key in sim if key == "rest_offset"]
    entries = params.get("actor_params") or {}
    if isinstance(entries, Mapping):  # null removes an actor that a base file defines
        entries = {actor: groups for actor, groups in entries.items() if groups is not None}
    _check_names(entries, actors, f"{WHERE}.actor_params", "actor")
    attributes: dict[tuple[str, str, str], AttributeSettings] = {}
    coloured: list[str] = []
    for actor, groups in entries.items():
        where = f"{WHERE}.actor_params.{actor}"
        _check_names(groups, (*PROPERTIES, "color", "scale"), where, "property")
        if groups.get("color", False):
            coloured.append(actor)
        if "scale" in groups:
            attributes[actor, "scale", ""] = _attribute(groups["scale"], f"{where}.scale")
        for group in (group for group in PROPERTIES if group in groups):
            _check_names(groups[group], PROPERTIES[group], f"{where}.{group}", "attribute")
            for name, entry in groups[group].items():
                attributes[actor, group, name] = _attribute(entry, f"{where}.{group}.{name}")
    return RandomizationPlan(
        frequency=_frequency(params),
        observations=_noise(params, "observations"),
        actions=_noise(params, "actions"),
        gravity=None if gravity is None else _attribute(gravity, f"{WHERE}.sim_params.gravity"),
        actors=attributes,
        coloured=tuple(coloured),
        unsupported=tuple(unsupported),
    )


def _frequency(params: Mapping[str, Any]) -> int:
    frequency = params.get("frequency", 1)
    if not isinstance(frequency, int) or isinstance(frequency, bool) or frequency < 1:
        raise ConfigError(f"{WHERE}.frequency: got {frequency!r}, expected a positive integer")
    return frequency


def _noise(params: Mapping[str, Any], what: str) -> NoiseSettings | None:
    if params.get(what) is None:
        return None
    settings = read_section(NoiseSettings, params[what], f"{WHERE}.{what}")
    _check_range(settings.range, settings.distribution, f"{WHERE}.{what}.range")
    correlated = f"{WHERE}.{what}.range_correlated"
    _check_range(settings.range_correlated, settings.distribution, correlated)
    return settings


def _attribute(entry: Any, where: str) -> AttributeSettings:
    settings = read_section(AttributeSettings, entry, where)
    _check_range(settings.range, settings.distribution, f"{where}.range")
    return settings


def _check_range(values: tuple[float, ...], distribution: str, where: str) -> None:
    first, second = values
    expected = {
        "gaussian": ("a mean and a standard deviation of at least 0", second >= 0),
        "uniform": ("a lower and an upper limit", first <= second),
        "loguniform": ("a lower and an upper limit above 0", 0 < first <= second),
    }
    limits, fits = expected[distribution]
    if not fits:
        raise ConfigError(f"{where}: got {list(values)}, expected {limits}")


def _check_names(entries: Any, known: Collection[str], where: str, what: str) -> None:
    if not isinstance(entries, Mapping):
        raise ConfigError(f"{where}: got {entries!r}, expected a mapping of {what} names")
    for name in entries:
        if name not in known:
            raise ConfigError(f"{where}: " + unknown(what, str(name), known))
