"""Lists the shipped moves as data."""

from __future__ import annotations

from typing import Any

from tools.clip_synthesis.moves.move import Carriage, Hop, Knots, Move, Steps

_STAND = Move(
    name="stand",
    window_s=(0.0, 4.0),
    carriage=Carriage(shoulder=((0, -3), (2, 1), (4, -3)), elbow=((0, 20), (2, 26), (4, 20))),
    straightest_knee=((0, 12),),
    sway_m=(0.008, 0.03),
)

_START = Move(
    name="start_walking",
    window_s=(0.3, 3.3),
    path=((0.8, 0, 0, 0), (2.0, 1.05, 0, 0)),
    steps=Steps(count=10, first_lift_s=1.0, step_s=0.45),
)

_STOP = Move(
    name="stop_walking",
    window_s=(2.6, 5.6),
    path=((0.8, 0, 0, 0), (2.0, 1.05, 0, 0), (3.6, 1.05, 0, 0), (4.8, 0, 0, 0)),
    steps=Steps(count=8, first_lift_s=1.0, step_s=0.45),
)

_WALK_LEFT = Move(
    name="walk_left",
    window_s=(2.92, 2.92 + 2.88),
    path=((0.8, 0, 0, 0), (2.0, 1.0, 0, 45)),
    steps=Steps(count=14, first_lift_s=1.0, step_s=0.48),
)

_WALK_BACKWARD = Move(
    name="walk_backward",
    window_s=(2.68, 2.68 + 2.52),
    path=((0.8, 0, 0, 0), (2.0, -1.0, 0, 0)),
    steps=Steps(count=14, first_lift_s=1.0, step_s=0.42, lift_deg=-5.0),
)

_SIDESTEP_LEFT = Move(
    name="sidestep_left",
    window_s=(2.8, 2.8 + 2.7),
    path=((0.8, 0, 0, 0), (2.4, 0, 0.45, 0)),
    # The width keeps the following foot clear of the leading foot.
    steps=Steps(count=14, first_lift_s=1.0, step_s=0.45, width_m=0.34),
)

_TURN_LEFT = Move(
    name="turn_left",
    window_s=(2.35, 2.35 + 2.7),
    path=((0.8, 0, 0, 0), (1.2, 0, 0, 55)),
    steps=Steps(count=12, first_lift_s=1.0, step_s=0.45, width_m=0.2),
)

_TURN_LEFT_FAST = Move(
    name="turn_left_fast",
    window_s=(2.11, 2.11 + 2.4),
    path=((0.8, 0, 0, 0), (1.3, 0, 0, 110)),
    steps=Steps(count=14, first_lift_s=1.0, step_s=0.4, width_m=0.22),
)

_WALK_LEFT_SHARP = Move(
    name="walk_left_sharp",
    window_s=(2.9, 2.9 + 2.4),
    path=((0.8, 0, 0, 0), (2.0, 0.8, 0, 90)),
    steps=Steps(count=16, first_lift_s=1.0, step_s=0.4, width_m=0.18, toe_out_deg=3.0),
)

_ABOUT_TURN_LEFT = Move(
    name="about_turn_left",
    window_s=(2.2, 2.2 + 3.6),
    path=(
        (0.8, 0, 0, 0),
        (1.8, 1.1, 0, 0),
        (2.6, 1.1, 0, 0),
        (3.3, 0.3, 0, 125),
        (4.1, 0.3, 0, 125),
        (4.9, 1.1, 0, 0),
    ),
    steps=Steps(count=15, first_lift_s=1.0, step_s=0.38, width_m=0.2),
)

_DIAGONAL_LEFT = Move(
    name="diagonal_left",
    window_s=(2.8, 2.8 + 2.7),
    path=((0.8, 0, 0, 0), (2.2, 0.65, 0.5, 0)),
    steps=Steps(count=14, first_lift_s=1.0, step_s=0.45, width_m=0.28),
)

_DIAGONAL_BACK_LEFT = Move(
    name="diagonal_back_left",
    window_s=(2.8, 2.8 + 2.52),
    path=((0.8, 0, 0, 0), (2.2, -0.55, 0.45, 0)),
    steps=Steps(count=14, first_lift_s=1.0, step_s=0.42, width_m=0.3, lift_deg=-5.0),
)


def _quick_step(name: str, forward_m_s: float, left_m_s: float, **steps: Any) -> Move:
    """Return one quick step from standing, and a second step to stand again.

    The speeds are the largest speeds of the body. `steps` are arguments of `Steps`.
    """
    return Move(
        name=name,
        window_s=(0.5, 2.4),
        path=((0.7, 0, 0, 0), (1.05, forward_m_s, left_m_s, 0), (1.6, 0, 0, 0)),
        steps=Steps(count=2, first_lift_s=0.85, step_s=0.42, **steps),
    )


_STEP_FORWARD = _quick_step("step_forward", 0.9, 0.0)
_STEP_BACK = _quick_step("step_back", -0.7, 0.0, lift_deg=-5.0)
_STEP_LEFT = _quick_step("step_left", 0.0, 0.6, width_m=0.2)

_CROUCH_WALK = Move(
    name="crouch_walk",
    window_s=(2.95, 2.95 + 3.3),
    path=((0.8, 0, 0, 0), (2.0, 0.65, 0, 0)),
    steps=Steps(count=12, first_lift_s=1.0, step_s=0.55, both_s=0.16, width_m=0.18),
    carriage=Carriage(
        lean=((0, 28),),
        pelvis_tilt=((0, 18),),
        shoulder=((0, 10),),
        elbow=((0, 55),),
        abduction_deg=14.0,
    ),
    straightest_knee=((0, 62),),
)

_JUMP = Move(
    name="jump",
    window_s=(0.2, 2.9),
    steps=Steps(width_m=0.2),
    carriage=Carriage(
        # Trunk and arms balance the angular momentum of the legs in flight. The trunk stretches
        # before take-off and bends with the legs. The arms swing earlier.
        lean=((0.4, 2), (0.92, 32), (1.18, 8), (1.4, 22), (1.56, 16), (1.8, 28), (2.4, 2)),
        pelvis_tilt=((0.4, 2), (0.92, 22), (1.18, 4), (1.4, 16), (1.56, 10), (1.8, 20), (2.4, 2)),
        shoulder=((0.4, -4), (0.88, -50), (1.22, 75), (1.95, 10), (2.5, -4)),
        elbow=((0.4, 22), (0.95, 25), (1.35, 50), (1.95, 35), (2.5, 22)),
        abduction_deg=12.0,
    ),
    hop=Hop(
        take_off_s=1.2,
        flight_s=0.34,
        forward_m=0.5,
        crouch_s=0.95,
        crouch_m=0.2,
        absorb_s=1.78,
        absorb_m=0.2,
        stand_s=(0.45, 2.4),
        lift_deg=-40.0,
        strike_deg=-12.0,
        roll_s=0.15,
        flat_s=0.08,
        tuck_m=0.03,
        give_m=0.035,
    ),
)

_HANGING_ARM = (-4.0, 7.0, 8.0, 22.0)


def _reach(
    name: str,
    arm: tuple[float, float, float, float],
    *,
    lean: float = 2.0,
    pelvis_tilt: float = 2.0,
    twist: float = 0.0,
    nod: float = 0.0,
    knee: float = 10.0,
    out_s: float = 0.7,
    width_m: float = 0.2,
) -> Move:
    """Return a reach with the right hand from standing: out in `out_s`, held, and back.

    `Carriage` describes the angles, `arm` has the order of its `right_arm`. `knee` is the flexion
    of the knees in the reach in degrees.
    """
    times_s = (0.5, 0.5 + out_s, 1.3 + out_s, 1.3 + 2.0 * out_s)

    def out_and_back(rest: tuple[float, ...], reached: tuple[float, ...]) -> Knots:
        values = (rest, reached, reached, rest)
        return tuple((time, *row) for time, row in zip(times_s, values, strict=True))

    return Move(
        name=name,
        window_s=(0.2, 1.6 + 2.0 * out_s),
        steps=Steps(width_m=width_m),
        straightest_knee=out_and_back((10.0,), (knee,)),
        carriage=Carriage(
            lean=out_and_back((2.0,), (lean,)),
            pelvis_tilt=out_and_back((2.0,), (pelvis_tilt,)),
            twist=out_and_back((0.0,), (twist,)),
            nod=out_and_back((0.0,), (nod,)),
            right_arm=out_and_back(_HANGING_ARM, arm),
        ),
    )


_REACHES = (
    _reach("reach_high", (170.0, 10.0, 0.0, 10.0), lean=-3.0, nod=-15.0, knee=5.0),
    _reach("reach_forward", (85.0, 0.0, 0.0, 8.0), lean=16.0, pelvis_tilt=8.0, twist=15.0),
    _reach("reach_side", (0.0, 85.0, 0.0, 10.0), twist=-5.0),
    _reach("reach_across", (75.0, -25.0, 0.0, 15.0), lean=8.0, twist=35.0),
    _reach(
        "reach_low",
        (60.0, 5.0, 0.0, 8.0),
        lean=55.0,
        pelvis_tilt=40.0,
        twist=10.0,
        nod=30.0,
        knee=90.0,
        out_s=1.0,
        width_m=0.26,
    ),
)

MOVES: dict[str, Move] = {
    move.name: move
    for move in (
        _STAND,
        _START,
        _STOP,
        _WALK_LEFT,
        _WALK_BACKWARD,
        _SIDESTEP_LEFT,
        _TURN_LEFT,
        _CROUCH_WALK,
        _JUMP,
        _TURN_LEFT_FAST,
        _WALK_LEFT_SHARP,
        _ABOUT_TURN_LEFT,
        _DIAGONAL_LEFT,
        _DIAGONAL_BACK_LEFT,
        _STEP_FORWARD,
        _STEP_BACK,
        _STEP_LEFT,
        *_REACHES,
    )
}

# Each name maps to the mirrored move.
MIRRORED: dict[str, str] = {
    "sidestep_right": "sidestep_left",
    "turn_right": "turn_left",
    "walk_right": "walk_left",
    "turn_right_fast": "turn_left_fast",
    "walk_right_sharp": "walk_left_sharp",
    "about_turn_right": "about_turn_left",
    "diagonal_right": "diagonal_left",
    "diagonal_back_right": "diagonal_back_left",
    "step_right": "step_left",
}
