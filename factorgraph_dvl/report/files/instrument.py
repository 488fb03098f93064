"""A calibration in the terms of instruments, as YAML with sign rules."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph_dvl.analysis.instrument_terms import ORDERS, Angles, InstrumentTerms, Order
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.notation import fixed

_ORDER_TEXT: dict[Order, str] = {
    "ZYX": "intrinsic ZYX: C = Rz(yaw) Ry(pitch) Rx(roll)",
    "XYZ": "intrinsic XYZ: C = Rx(roll) Ry(pitch) Rz(yaw)",
}


def instrument_text(instrument: InstrumentTerms, name: str) -> str:
    """Return the text of `instrument.yaml`.

    Parameters
    ----------
    instrument : InstrumentTerms
        Terms to write.
    name : str
        Name of the calibrated trial.
    """
    i = instrument
    lines = [
        f"# Calibration from trial {name}, in the terms of instruments.",
        "#",
        "# Angles: roll about the forward axis (positive starboard down), pitch about the",
        "# starboard axis (positive bow up), yaw about the downward axis (positive clockwise from",
        "# above). The DVL's axes are named as the body's are: if aligned, it has zero angles.",
        "",
        "# Attitude of the DVL in the vehicle, C_d^b: DVL components to body components.",
        "dvl_in_body:",
        *_angles(i.dvl_in_body),
        "",
        "# C_b^d: body components to DVL components.",
        "body_to_dvl:",
        *_angles(i.body_to_dvl),
        "",
        "# The DVL reads (1 + error) times the velocity; multiply its velocity by the factor.",
        f"scale_error_percent: {_list(100.0 * i.scale_error, 4)}",
        f"scale_error_std_percent: {_list(100.0 * i.scale_std, 4)}",
        f"scale_error_ppm: {_list(1e6 * i.scale_error, 0)}",
        f"scale_error_std_ppm: {_list(1e6 * i.scale_std, 0)}",
        f"scale_factor: {_list(1.0 / (1.0 + i.scale_error), 6)}",
        "",
        "# From the IMU to the DVL: forward, starboard, down.",
        f"lever_arm_m: {_list(i.lever_arm, 4)}",
        f"lever_arm_std_m: {_list(i.lever_arm_std, 4)}",
        "",
        "# TRDI, 0.01 deg. EA is the direction of beam 3 seen from the ship's bow, positive",
        "# clockwise from above. EI and EJ are roll and pitch of the ship when the instrument is",
        "# level, positive port side up and bow up: Rz(-EA) Ry(EJ) Rx(EI) takes ship to",
        "# instrument. They are valid for a DVL that looks down, if the trial was recorded in",
        "# instrument coordinates (aligned: X to starboard, Y, beam 3, ahead, Z up) with EA, EI",
        "# and EJ at 0, and if the body axes are parallel to those of the ship. EI and EJ are as",
        "# in the Pathfinder DVL Guide (2018). The sign of EA is NOT VERIFIED against a manual.",
        *(_NOT_TRDI if np.max(np.abs(i.alignment[1:])) > _UPSIDE_DOWN_DEG else ()),
        "trdi:",
        *[
            f"  {name}: {_hundredths(value)}                 # {_command(name, value)}, "
            f"± {fixed(std, 4)} deg"
            for name, value, std in zip(
                ("EA", "EI", "EJ"), i.alignment.tolist(), i.alignment_std.tolist(), strict=True
            )
        ],
    ]
    return "\n".join([*lines, *_makers(i)]) + "\n"


def _makers(i: InstrumentTerms) -> list[str]:
    """Return the calibration in the conventions of other makers, with their sign rules."""
    roll, pitch, yaw = (float(x) for x in i.dvl_in_body["ZYX"].value)
    mean = float(np.mean(i.scale_error))
    forward, starboard, down = (float(x) for x in i.lever_arm)
    upside_down = max(abs(roll), abs(pitch)) > _UPSIDE_DOWN_DEG
    tilt = float(np.hypot(roll, pitch))
    return [
        "",
        "# Nortek: attitude of the DVL in the vehicle, axes forward, starboard, down; yaw first,",
        "# then pitch, then roll; each positive by the right hand about its axis.",
        f"# {_NOT_VERIFIED}",
        "nortek:",
        f"  roll_pitch_yaw_deg: {_list([roll, pitch, yaw], 2)}",
        "",
        "# Water Linked: one angle, from the vehicle's forward axis to that of the DVL, positive",
        "# clockwise from above, in whole degrees from 0 to 359. Sign rule: DVL documentation,",
        f"# page Axes. The angle is {fixed(yaw, 2)} deg; the rest and the tilt of "
        f"{fixed(tilt, 2)} deg are left out.",
        *(("# DO NOT TYPE IN: the DVL's axes look up.",) if upside_down else ()),
        "water_linked:",
        f"  mounting_rotation_offset: {round(yaw) % 360}",
        "",
        "# Delph-style: axes X1 forward, X2 to port, X3 up. Heading is positive clockwise from",
        "# above, roll positive port side up, pitch positive bow down. The scale factor is what",
        "# the DVL reads too much, in %; the lever arm runs from the IMU to the DVL.",
        f"# {_NOT_VERIFIED}",
        "delph:",
        f"  heading_pitch_roll_deg: {_list([yaw, -pitch, roll], 4)}",
        f"  scale_factor_percent: {fixed(100.0 * mean, 4)}",
        f"  lever_arm_x1_x2_x3_m: {_list([forward, -starboard, -down], 4)}",
    ]


_NOT_VERIFIED = (
    "The signs are NOT VERIFIED against the maker's manual: check one of them before use."
)
# Chosen: a DVL that looks down has a smaller roll and pitch.
_UPSIDE_DOWN_DEG = 90.0
_NOT_TRDI = (
    "# DO NOT TYPE IN: with these values, the instrument would look up. The DVL's data in this",
    "# trial are in other axes than TRDI's; convert them, and calibrate again.",
)


def _angles(by_order: dict[Order, Angles]) -> list[str]:
    out = []
    for order in ORDERS:
        angles = by_order[order]
        out += [
            f"  {order}:                             # {_ORDER_TEXT[order]}",
            f"    roll_pitch_yaw_deg: {_list(angles.value, 4)}",
            f"    std_deg: {_list(angles.std, 4)}",
        ]
    return out


def _list(values: Array | Sequence[float], decimals: int) -> str:
    return "[" + ", ".join(fixed(float(v), decimals) for v in values) + "]"


def _hundredths(angle: float) -> int:
    """Return an angle, deg, in hundredths within -17999 to 18000."""
    hundredths = round(100.0 * angle)
    return hundredths + 36000 if hundredths <= -18000 else hundredths


def _command(name: str, angle: float) -> str:
    prefix = "" if name == "EA" else "#"
    return f"{prefix}{name}{_hundredths(angle):+06d}"
