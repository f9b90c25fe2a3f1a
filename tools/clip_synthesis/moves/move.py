"""Describes a move as plain data."""

from __future__ import annotations

from dataclasses import dataclass, field

Knots = tuple[tuple[float, ...], ...]
"""Rows (time_s, value, ...) in the order of time; `path.ease` interpolates them smoothly."""


@dataclass(frozen=True)
class Steps:
    """Footsteps; the feet are lifted in turns, one every `step_s`.

    A pitch is the angle of the foot to the ground, toes up positive. Pitches grow with the forward
    length of the step in m. Long steps land on the heel, and backward steps land on the toes.

    Attributes:
        count: number of steps; 0 is standing.
        first_foot: `right` or `left`.
        first_lift_s: time at which the first foot leaves the ground.
        step_s: time from step to step.
        both_s: time in each step with both feet on the ground.
        width_m: lateral distance of the feet's centres.
        toe_out_deg: angle of the feet to the heading.
        clearance_m: height of the sole's lowest edge in mid-swing.
        strike_deg_per_m: pitch at touch-down per m of step length.
        lift_deg: pitch at lift-off for a step on the spot.
        lift_deg_per_m: additional pitch at lift-off per m of step length.
        flat_s: time from touch-down until the sole is flat.
        roll_s: time from the flat sole to lift-off.
    """

    count: int = 0
    first_foot: str = "left"
    first_lift_s: float = 1.0
    step_s: float = 0.5
    both_s: float = 0.12
    width_m: float = 0.16
    toe_out_deg: float = 6.0
    clearance_m: float = 0.04
    strike_deg_per_m: float = 18.0
    lift_deg: float = -12.0
    lift_deg_per_m: float = -26.0
    flat_s: float = 0.10
    roll_s: float = 0.22


@dataclass(frozen=True)
class Hop:
    """A jump off both feet.

    Attributes:
        take_off_s: time at which the feet leave the ground.
        flight_s: time in the air.
        forward_m: length of the jump.
        crouch_s, crouch_m: time and depth of the lowest point before take-off, below standing.
        absorb_s, absorb_m: time and depth of the lowest point after landing, below standing.
        stand_s: end of the first standing and start of the last standing.
        lift_deg, strike_deg: pitch of the feet at take-off and landing.
        roll_s, flat_s: see `Steps`.
        tuck_m: additional lift of the feet in mid-flight over free fall.
        give_m: lowering of the body at take-off and landing relative to stretched legs.
    """

    take_off_s: float
    flight_s: float
    forward_m: float
    crouch_s: float
    crouch_m: float
    absorb_s: float
    absorb_m: float
    stand_s: tuple[float, float]
    lift_deg: float
    strike_deg: float
    roll_s: float
    flat_s: float
    tuck_m: float
    give_m: float


@dataclass(frozen=True)
class Carriage:
    """Posture of trunk, head and arms; all angles are in degrees.

    Attributes:
        lean: knots of the thorax' forward lean.
        pelvis_tilt: knots of the pelvis' forward tilt.
        shoulder: knots of the upper arms' forward angle to the thorax.
        elbow: knots of the elbows' flexion.
        arm_swing_deg_per_m: swing of an arm per m of distance between the feet. Each arm moves
            forward with the opposite foot.
        elbow_share: additional elbow flexion per angle of swing.
        pelvis_turn_deg_per_m, thorax_turn_deg_per_m: turn per m of distance between the feet. The
            pelvis turns with the front foot, the thorax against it.
        pelvis_drop_deg: drop of the pelvis on the side of the unloaded foot.
        look_ahead_s: the head faces the heading of the body after this time.
        abduction_deg, rotation_deg: angle of the upper arm to the trunk, and its inward turn.
        twist: knots of the thorax' turn to the left.
        nod: knots of the head's angle to the horizon, down positive.
        right_arm: knots (time_s, shoulder, abduction, rotation, elbow), which replace the swing of
            the right arm unless they are empty.
    """

    lean: Knots = ((0.0, 2.0),)
    pelvis_tilt: Knots = ((0.0, 2.0),)
    shoulder: Knots = ((0.0, -4.0),)
    elbow: Knots = ((0.0, 22.0),)
    arm_swing_deg_per_m: float = 35.0
    elbow_share: float = 0.5
    pelvis_turn_deg_per_m: float = 8.0
    thorax_turn_deg_per_m: float = 6.0
    pelvis_drop_deg: float = 2.5
    look_ahead_s: float = 0.3
    abduction_deg: float = 7.0
    rotation_deg: float = 8.0
    twist: Knots = ((0.0, 0.0),)
    nod: Knots = ((0.0, 0.0),)
    right_arm: Knots = ()


@dataclass(frozen=True)
class Move:
    """One move; it is planned from standing to standing, and the clip is a part of the plan.

    Attributes:
        name: name of the clip.
        window_s: start and end of the clip.
        path: knots (time_s, forward m/s, left m/s, left turn deg/s) of the body's velocity in its
            heading frame.
        steps: the footsteps.
        carriage: posture of trunk, head and arms.
        straightest_knee: knots of the smallest knee flexion in degrees, which sets the height of
            the body.
        sway_m: forward and left amplitude of the centre of pressure in standing.
        sway_s: period of the left sway; the forward sway has half of this period.
        hop: a jump in place of steps.
    """

    name: str
    window_s: tuple[float, float]
    path: Knots = ((0.0, 0.0, 0.0, 0.0),)
    steps: Steps = field(default_factory=Steps)
    carriage: Carriage = field(default_factory=Carriage)
    straightest_knee: Knots = ((0.0, 10.0),)
    sway_m: tuple[float, float] = (0.0, 0.0)
    sway_s: float = 4.0
    hop: Hop | None = None
