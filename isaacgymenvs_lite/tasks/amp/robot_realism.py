"""The keys of `task.env` that bring a simulated robot nearer to a real one, with their checks."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.schema import read_section, setting

_MAX_FRAMES = 100
_MAX_DELAY = 100  # control steps


@dataclass(frozen=True, kw_only=True)
class ObservationNoise:
    """`task.env.observationNoise`: half widths of uniform noise on the parts of a frame."""

    root_ang_vel_b: float = setting(0.0, minimum=0)
    """rad/s."""
    gravity_b: float = setting(0.0, minimum=0)
    """Of the unit vector, which stays one."""
    dof_pos_offset: float = setting(0.0, minimum=0)
    """rad."""
    dof_vel: float = setting(0.0, minimum=0)
    """rad/s."""

    @property
    def widths(self) -> dict[str, float]:
        """Half width of each part by its name."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True)
class RealismSettings:
    """What a policy observes, and what disturbs it; all disturbances are off by default."""

    observations: str = setting("full", choices=("full", "deployable"))
    """What the policy observes: all of the simulated state, or what a robot measures."""
    history_steps: int = setting(1, key="historySteps", minimum=1, maximum=_MAX_FRAMES)
    """Frames in a `deployable` observation, one for each of the last control steps."""
    observation_noise: ObservationNoise = field(
        default_factory=ObservationNoise, metadata={"key": "observationNoise"}
    )
    """On `deployable` frames."""
    action_delay: tuple[int, ...] = setting(
        (0, 0), key="actionDelay", minimum=0, maximum=_MAX_DELAY, length=2
    )
    """Control steps from a policy's choice to its effect, least and most; drawn per episode."""
    push_robots: bool = setting(False, key="pushRobots")
    """Change the velocities of the bases now and then."""
    push_interval_s: float = setting(5.0, key="pushInterval_s", above=0)
    """From one push of all robots to the next."""
    push_velocity: float = setting(0.5, key="pushVelocity", minimum=0, maximum=100)
    """Largest change of the velocity along each axis of the ground, m/s."""

    @property
    def is_deployable(self) -> bool:
        """Whether the policy observes only what a robot measures."""
        return self.observations == "deployable"


def check_realism(settings: RealismSettings, env: dict[str, Any]) -> None:
    """Check the keys that depend on each other.

    Args:
        settings: `task.env`, read.
        env: `task.env`.

    Raises:
        ConfigError: an empty range, an unknown part, or a key that has no effect.
    """
    # Once more as a whole section: a part that does not exist would be left without its noise.
    noise = env.get("observationNoise")
    read_section(ObservationNoise, noise, "task.env.observationNoise", complete=True)
    unread = sorted(set(noise or ()) - set(settings.observation_noise.widths))
    if unread:
        raise ConfigError(
            f"task.env.observationNoise.{unread[0]}: no measured part has this name; choices:"
            f" {', '.join(settings.observation_noise.widths)}"
        )
    least, most = settings.action_delay
    if least > most:
        raise ConfigError(
            f"task.env.actionDelay=[{least}, {most}]: expected the least number of control steps,"
            " then the most"
        )
    if settings.is_deployable:
        return
    if settings.history_steps > 1:
        raise ConfigError(
            f"task.env.historySteps={settings.history_steps}: only observations of a robot's own"
            " measurements have a history; add task.env.observations=deployable, or leave it 1"
        )
    if any(settings.observation_noise.widths.values()):
        raise ConfigError(
            "task.env.observationNoise is of a robot's measurements; add"
            " task.env.observations=deployable (noise on the full observation:"
            " task.task.randomization_params.observations)"
        )
