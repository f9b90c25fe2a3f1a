"""Holds published angles, timing and forces of walking and running as tables over the gait cycle.

The cycle starts when the right foot touches the ground. The tables hold the right side in degrees
at every 5 % of the cycle. The left side is equal half a cycle later. The tables follow the curves
of a typical adult in the publications of each gait, rounded to degrees. They were not digitised
from the figures and do not describe one person.

Joint angles are relative to upright standing with a level pelvis and all joints at zero. Gait
laboratories measure hip angles from a pelvis that is tilted forward by about 12 degrees in
standing. The tables of running were published in this way, therefore 12 degrees were subtracted
from pelvis tilt and hip flexion.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

Table = tuple[float, ...]


@dataclass(frozen=True)
class Gait:
    """One gait. Phases are fractions of the cycle, angles are in degrees.

    Full-cycle tables hold 20 values (0, 5, ... 95 %) of the right side. Half-cycle tables hold 10
    values (0, 5, ... 45 %), and pelvis and thorax move in the mirror image in the second half.

    Attributes:
        name: name of the clip.
        period_s: time of one cycle of two steps.
        stride_m: distance of one cycle.
        duty: phase at which the right foot leaves the ground.
        foot_flat: phase at which the sole lies on the ground.
        heel_off: phase at which the heel leaves the ground.
        strike_pitch_deg: angle of the foot to the ground at touch-down, toes up positive.
        toe_off_pitch_deg: angle of the foot when it leaves the ground, negative for toes down.
        force_shape: q of Alexander and Jayes: force ~ cos(pi s) - q cos(3 pi s), -1/2 < s < 1/2.
        step_width_m: lateral distance of the feet's centres.
        toe_out_deg: angle of the feet to the direction of travel.
        swing_out_m: outward shift of the swinging foot past the other leg.
        swing_knee_deg: additional knee flexion in mid-swing, which lifts the foot.
        swing_toe_up_deg: additional pitch of the foot in mid-swing, because the foot is rigid.
        retraction_deg: backward rate of the thigh at touch-down per cycle.
        straightest_knee_deg: smallest knee flexion of the stance, which sets the pelvis height.
        pelvis_tilt: half cycle, forward positive.
        pelvis_obliquity: half cycle, right side up positive.
        pelvis_rotation: half cycle, right side forward positive.
        thorax_rotation: half cycle, right side forward positive, relative to the world.
        thorax_lean_deg: forward lean of the thorax.
        hip_flexion, knee_flexion, ankle_dorsiflexion: full cycle.
        shoulder_flexion, elbow_flexion: full cycle; the shoulder is relative to the thorax.
        shoulder_abduction_deg: angle of the arm to the trunk.
        shoulder_rotation_deg: turn of the upper arm about its axis, forearm inwards positive.
    """

    name: str
    period_s: float
    stride_m: float
    duty: float
    foot_flat: float
    heel_off: float
    strike_pitch_deg: float
    toe_off_pitch_deg: float
    force_shape: float
    step_width_m: float
    toe_out_deg: float
    swing_out_m: float
    swing_knee_deg: float
    swing_toe_up_deg: float
    retraction_deg: float
    straightest_knee_deg: float
    pelvis_tilt: Table
    pelvis_obliquity: Table
    pelvis_rotation: Table
    thorax_rotation: Table
    thorax_lean_deg: float
    hip_flexion: Table
    knee_flexion: Table
    ankle_dorsiflexion: Table
    shoulder_flexion: Table
    elbow_flexion: Table
    shoulder_abduction_deg: float
    shoulder_rotation_deg: float


# Sources of walking:
# - D. A. Winter, Biomechanics and Motor Control of Human Movement, Wiley (2nd ed. 1990), and The
#   Biomechanics and Motor Control of Human Gait, Univ. of Waterloo Press (2nd ed. 1991): hip, knee
#   and ankle angles at natural cadence.
# - J. Perry, J. M. Burnfield, Gait Analysis: Normal and Pathological Function, Slack (2nd ed.
#   2010): pelvis, arm swing (24 deg extension to 8 deg flexion at the shoulder, 20 to 45 deg at the
#   elbow), foot rockers and their timing.
# - M. P. Murray, Gait as a total pattern of movement, Am. J. Phys. Med. 46 (1967) 290-333: thorax
#   against pelvis, toe-out, width of the base.
# - R. McN. Alexander, A. S. Jayes, Fourier analysis of forces exerted in walking and running,
#   J. Biomech. 13 (1980) 383-390: shape of the vertical ground reaction force.
#
# The stride suits legs of 0.88 m and short feet. The rigid foot of 0.18 m ends before the toes.
# Therefore the steps are quick for the speed.
WALK = Gait(
    name="walk",
    period_s=54 / 60,
    stride_m=1.17,
    duty=0.58,
    foot_flat=0.10,
    heel_off=0.40,
    strike_pitch_deg=20.0,
    toe_off_pitch_deg=-45.0,
    force_shape=0.45,
    step_width_m=0.13,
    toe_out_deg=6.0,
    swing_out_m=0.01,
    swing_knee_deg=3.0,
    swing_toe_up_deg=14.0,
    retraction_deg=40.0,
    straightest_knee_deg=8.0,
    pelvis_tilt=(2, 1, 1, 1, 1, 2, 2, 3, 3, 3),
    pelvis_obliquity=(0, 2, 4, 4, 4, 3, 2, 1, 1, 0),
    pelvis_rotation=(5, 5, 4, 3, 2, 0, -1, -3, -4, -5),
    thorax_rotation=(-4, -4, -3, -2, -1, 0, 1, 2, 3, 4),
    thorax_lean_deg=2.0,
    hip_flexion=(
        *(21, 20, 17, 13, 8, 4, 0, -4, -7, -10),
        *(-11, -9, -4, 4, 11, 17, 21, 22, 22, 21),
    ),
    knee_flexion=(
        *(4, 10, 17, 20, 18, 15, 11, 8, 6, 7),
        *(11, 21, 36, 54, 64, 63, 52, 36, 18, 6),
    ),
    ankle_dorsiflexion=(
        *(0, -4, -2, 2, 4, 6, 7, 8, 9, 9),
        *(5, -5, -16, -18, -11, -5, -1, 0, 1, 1),
    ),
    shoulder_flexion=(
        *(-24, -23, -21, -18, -13, -8, -3, 2, 5, 7),
        *(8, 8, 6, 3, -1, -6, -11, -16, -20, -23),
    ),
    elbow_flexion=(
        *(20, 20, 21, 23, 26, 30, 34, 38, 41, 43),
        *(45, 44, 42, 39, 35, 31, 27, 24, 22, 21),
    ),
    shoulder_abduction_deg=6.0,
    shoulder_rotation_deg=8.0,
)

# Sources of running:
# - T. F. Novacheck, The biomechanics of running, Gait and Posture 7 (1998) 77-95: pelvis, hip, knee
#   and ankle angles and timing at about 3.2 m/s.
# - A. G. Schache et al., The coordinated movement of the lumbo-pelvic-hip complex during running: a
#   literature review, Gait and Posture 10 (1999) 30-47: lean of the trunk, thorax against pelvis.
# - R. N. Hinrichs, Upper extremity function in running. II: Angular momentum considerations,
#   Int. J. Sport Biomech. 3 (1987) 242-263, and A. K. Yegian et al., Straight arm walking, bent arm
#   running, J. Exp. Biol. 222 (2019) jeb197228: arm swing with elbows near 90 deg.
# - R. McN. Alexander, A. S. Jayes (see walking), and J.-B. Morin et al., A simple method for
#   measuring stiffness during running, J. Appl. Biomech. 21 (2005) 167-180: the vertical force of a
#   step is half a sine.
RUN = Gait(
    name="run",
    period_s=40 / 60,
    stride_m=1.90,
    duty=0.34,
    foot_flat=0.05,
    heel_off=0.14,
    strike_pitch_deg=8.0,
    toe_off_pitch_deg=-40.0,
    force_shape=0.0,
    step_width_m=0.09,
    toe_out_deg=5.0,
    swing_out_m=0.04,
    swing_knee_deg=0.0,
    swing_toe_up_deg=8.0,
    retraction_deg=40.0,
    straightest_knee_deg=16.0,
    pelvis_tilt=(6, 5, 5, 5, 6, 8, 9, 9, 8, 7),
    pelvis_obliquity=(1, 3, 5, 5, 4, 3, 1, 0, -1, -1),
    pelvis_rotation=(0, -2, -3, -4, -5, -5, -4, -3, -2, -1),
    thorax_rotation=(-9, -8, -7, -5, -2, 1, 4, 6, 8, 9),
    thorax_lean_deg=8.0,
    hip_flexion=(
        *(30, 29, 26, 20, 13, 5, -3, -9, -12, -10),
        *(-3, 6, 16, 26, 34, 39, 41, 40, 36, 32),
    ),
    knee_flexion=(
        *(16, 28, 38, 42, 40, 34, 26, 20, 22, 36),
        *(56, 75, 88, 93, 90, 78, 59, 38, 21, 13),
    ),
    ankle_dorsiflexion=(
        *(5, 8, 14, 19, 20, 15, 3, -12, -20, -17),
        *(-10, -5, -2, 0, 2, 4, 5, 5, 5, 5),
    ),
    shoulder_flexion=(
        *(-45, -42, -37, -30, -22, -14, -6, 0, 4, 6),
        *(7, 5, 1, -5, -12, -20, -28, -35, -41, -44),
    ),
    elbow_flexion=(
        *(85, 85, 86, 88, 91, 94, 97, 100, 102, 104),
        *(105, 104, 103, 101, 98, 95, 92, 89, 87, 86),
    ),
    shoulder_abduction_deg=16.0,
    shoulder_rotation_deg=20.0,
)


def _scaled(table: Table, factor: float, centre_deg: float = 0.0) -> Table:
    """Scale the distances of the values to a centre and round to whole degrees."""
    return tuple(round(centre_deg + factor * (value - centre_deg)) for value in table)


# Slow and fast walking have the same curves with smaller and larger amplitudes (Winter 1991, Murray
# 1967). The factors were chosen for the stride of this humanoid.
WALK_SLOW = dataclasses.replace(
    WALK,
    name="walk_slow",
    period_s=36 / 30,
    stride_m=0.90,
    duty=0.60,
    heel_off=0.42,
    strike_pitch_deg=14.0,
    toe_off_pitch_deg=-38.0,
    force_shape=0.2,
    step_width_m=0.14,
    swing_knee_deg=9.0,
    retraction_deg=120.0,
    straightest_knee_deg=10.0,
    pelvis_rotation=_scaled(WALK.pelvis_rotation, 0.7),
    thorax_rotation=_scaled(WALK.thorax_rotation, 0.7),
    hip_flexion=_scaled(WALK.hip_flexion, 0.78, 5.0),
    shoulder_flexion=_scaled(WALK.shoulder_flexion, 0.55, -6.0),
    elbow_flexion=_scaled(WALK.elbow_flexion, 0.5, 22.0),
)
WALK_FAST = dataclasses.replace(
    WALK,
    name="walk_fast",
    period_s=24 / 30,
    stride_m=1.30,
    duty=0.56,
    strike_pitch_deg=22.0,
    toe_off_pitch_deg=-50.0,
    force_shape=0.6,
    thorax_lean_deg=4.0,
    pelvis_rotation=_scaled(WALK.pelvis_rotation, 1.3),
    thorax_rotation=_scaled(WALK.thorax_rotation, 1.3),
    hip_flexion=_scaled(WALK.hip_flexion, 1.12, 5.0),
    shoulder_flexion=_scaled(WALK.shoulder_flexion, 1.3, -6.0),
    elbow_flexion=_scaled(WALK.elbow_flexion, 1.2, 20.0),
)

GAITS: dict[str, Gait] = {gait.name: gait for gait in (WALK, RUN, WALK_SLOW, WALK_FAST)}
