"""What a move is made of: plain data, in the words of somebody who describes how people move."""

from __future__ import annotations

from dataclasses import dataclass, field

Knots = tuple[tuple[float, ...], ...]
"""Rows (time_s, value, ...) in the order of time; between them values go over smoothly."""


@dataclass(frozen=True)
class Steps:
    """Footsteps: one foot after the other is lifted, every `step_s`.

    Pitches are angles of the foot to the ground, toes up positive. They grow with the way that the
    foot goes forward (m): long steps land on the heel, steps backwards on the toes.

    Attributes:
        count: number of steps; 0 is standing.
        first_foot: `right` or `left`.
        first_lift_s: time at which the first foot leaves the ground.
        step_s: time from step to step.
        both_s: time of a step that both feet are on the ground.
        width_m: distance of the feet's middle lines.
        toe_out_deg: angle of the feet to the direction of the body.
        clearance_m: height of the sole's lowest edge in mid-swing.
        strike_deg_per_m: pitch at touch-down.
        lift_deg: pitch at lift-off of a step on the spot.
        lift_deg_per_m: its growth with the way forward.
        flat_s: time from touch-down until the sole is flat.
        roll_s: time from when the sole is no longer flat until lift-off.
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
        forward_m: how much further the feet land.
        crouch_s: when the body is lowest before the push; `crouch_m` lower than in standing.
        absorb_s: when it is lowest after landing, `absorb_m` lower.
        stand_s: (end of standing, standing again).
        lift_deg, strike_deg: pitch of the feet as they leave and meet the ground.
        roll_s, flat_s: as for steps.
        tuck_m: how much further the feet are drawn up in mid-flight than they fall freely.
        give_m: how much lower the body is at take-off and landing than with stretched legs.
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
    """How trunk, head and arms are held. Angles in degrees.

    Attributes:
        lean: knots of the thorax' forward lean.
        pelvis_tilt: knots of the pelvis' forward tilt.
        shoulder: knots of the upper arms' forward angle to the thorax.
        elbow: knots of the elbows' flexion.
        arm_swing_deg_per_m: how far the arms swing for the way between the feet; the arm goes
            forward with the foot of the other side.
        elbow_share: how much the elbow bends further per angle of swing.
        pelvis_turn_deg_per_m, thorax_turn_deg_per_m: how pelvis and thorax turn with the way
            between the feet: the pelvis forward with the foot, the thorax against it.
        pelvis_drop_deg: how much the pelvis' other side drops while one foot carries the body.
        look_ahead_s: the head looks where the body will be turned so much later.
        abduction_deg, rotation_deg: the upper arm from the trunk, and about itself (inwards).
        twist: knots of the thorax' turn to the left.
        nod: knots of the head's angle to the horizon, down positive.
        right_arm: knots (time_s, shoulder, abduction, rotation, elbow), what the right arm does in
            the place of swinging; (): it swings.
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
    """One move; it is planned from standing to standing, and the clip shows a part of that.

    Attributes:
        name: of the clip.
        window_s: (start, end) of the clip.
        path: knots (time_s, forward m/s, to the left m/s, turn to the left deg/s): where the body
            goes, in its own frame.
        steps: how the feet follow.
        carriage: how the rest is held.
        straightest_knee: knots of the straightest knee's flexion in degrees; decides how high the
            body is.
        sway_m: (forward, to the left) amplitude of the pressure under standing feet, over
            `sway_s`; forward twice in that time.
        sway_s: see there.
        hop: a jump off both feet, in the place of steps.
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
