"""The moves that ship, as data."""

from __future__ import annotations

from tools.clip_synthesis.moves.move import Carriage, Hop, Move, Steps

_STAND = Move(
    name="stand",
    window_s=(0.0, 4.0),
    carriage=Carriage(shoulder=((0, -3), (2, 1), (4, -3)), elbow=((0, 20), (2, 26), (4, 20))),
    straightest_knee_deg=12.0,
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
    # So wide that the following foot does not meet the leading one.
    steps=Steps(count=14, first_lift_s=1.0, step_s=0.45, width_m=0.34),
)

_TURN_LEFT = Move(
    name="turn_left",
    window_s=(2.35, 2.35 + 2.7),
    path=((0.8, 0, 0, 0), (1.2, 0, 0, 55)),
    steps=Steps(count=12, first_lift_s=1.0, step_s=0.45, width_m=0.2),
)

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
    straightest_knee_deg=62.0,
)

_JUMP = Move(
    name="jump",
    window_s=(0.2, 2.9),
    steps=Steps(width_m=0.2),
    carriage=Carriage(
        # Timed so that the legs, drawn up in flight, do not ask for angular momentum: the trunk
        # stretches before take-off and bends with the legs, the arms swing before.
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
    )
}

# Clips that are mirror images of others.
MIRRORED: dict[str, str] = {
    "sidestep_right": "sidestep_left",
    "turn_right": "turn_left",
    "walk_right": "walk_left",
}
