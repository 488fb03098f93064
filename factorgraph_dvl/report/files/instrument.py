"""A calibration in the terms of instruments, as YAML with sign rules."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from factorgraph_dvl.analysis.instrument_terms import (
    NORTEK_AXES,
    ORDERS,
    TRDI_AXES,
    WATER_LINKED_AXES,
    Angles,
    InstrumentTerms,
    Order,
    instrument_of,
    transceiver_of,
)
from factorgraph_dvl.analysis.mount import looks_down, mount_in_words
from factorgraph_dvl.errors import printable
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.notation import at_precision, fixed, sentence
from factorgraph_dvl.quality.texts import text_of
from factorgraph_dvl.quality.verdict import Grade, Verdict
from factorgraph_dvl.report.entries import (
    RECORDED_AXES,
    REFUSED,
    TITLE,
    USBL_DEFINITIONS,
    USBL_TITLE,
    Entry,
    definitions,
    entries_of,
    hundredths,
    sum_with_compass,
    usbl_entries,
    worst,
)
from factorgraph_dvl.solution import Calibration, Solution

_ORDER_TEXT: dict[Order, str] = {
    "ZYX": "intrinsic ZYX: C = Rz(yaw) Ry(pitch) Rx(roll)",
    "XYZ": "intrinsic XYZ: C = Rx(roll) Ry(pitch) Rz(yaw)",
}


def verdict_text(verdict: Verdict) -> str:
    """Return the verdict and all its reasons as comments of YAML, a line each."""
    reasons = (
        f"#   {r.severity}: {sentence(printable(str(r)))} {r.code.action}" for r in verdict.reasons
    )
    return "\n".join([f"# Verdict: {verdict.grade}", *reasons]) + "\n"


def instrument_text(calibration: Calibration | Solution) -> str:
    """Return the text of `instrument.yaml`.

    Parameters
    ----------
    calibration : Calibration or Solution
        Calibration of a DVL. Its red and grey values are comments, with the reason.

    Raises
    ------
    DataError
        If it has no misalignment, scale error or lever arm.
    """
    i = instrument_of(calibration)
    both = sum_with_compass(calibration.findings)
    lines = [
        *([] if both is None else [f"# Mount and compass: {printable(str(both))}.", "#"]),
        f"# Calibration from trial {printable(calibration.trial)}.",
        "#",
        "# Angles: roll about the forward axis (positive starboard down), pitch about the",
        "# starboard axis (positive bow up), yaw about the downward axis (positive clockwise from",
        "# above). The DVL's axes are named as the body's are: if aligned, it has zero angles.",
        "",
        f"# {TITLE}. {definitions(i)[0]}",
        "# The DVL reads (1 + scale error) times the velocity.",
        *(f"# {said}" for said in definitions(i)[1:]),
        "enter_in_dvl:",
        *map(_entry, entries_of(i)),
        "",
        "# The mount, with the axes of the DVL as they were recorded:",
        *(f"# {text_of(sentence)}" for sentence in mount_in_words(i.axes)),
        *_of_usbl(calibration),
        *_further(i),
    ]
    return verdict_text(calibration.verdict) + "\n".join(lines) + "\n"


def _of_usbl(calibration: Calibration | Solution) -> Iterator[str]:
    """Yield what to enter in a USBL, if its mounting was estimated."""
    terms = transceiver_of(calibration)
    if terms is None:
        return
    yield from ("", f"# {USBL_TITLE}.", *(f"# {said}" for said in USBL_DEFINITIONS))
    yield "enter_in_usbl:"
    yield from map(_entry, usbl_entries(terms))


def _entry(e: Entry) -> str:
    """Return the line of a number to enter."""
    about = f"± {at_precision(e.std, e.std)}; positive: {e.rule}"
    return _line(f"  {e.key}: {e.text}", e.grade, about)


def _line(text: str, grade: Grade, about: str = "") -> str:
    """Return a line of YAML with its grade; a comment where the value must not be entered."""
    if reason := REFUSED.get(grade):
        name, _, value = text.partition(":")
        indent = name[: len(name) - len(name.lstrip())]
        return f"{indent}# {name.strip()}:{value}  # {grade}: {reason}"
    return f"{text}  # {about + '; ' if about else ''}{grade}"


def _further(i: InstrumentTerms) -> Iterator[str]:
    """Yield the calibration in further conventions, and in those of makers."""
    angles, arm, scale = (worst(g) for g in _grades(i))
    yield from (
        "",
        "# Attitude of the DVL in the vehicle, C_d^b: DVL components to body components.",
    )
    yield "dvl_in_body:"
    yield from _angles(i.dvl_in_body)
    yield from ("", "# C_b^d: body components to DVL components.", "body_to_dvl:")
    yield from _angles(i.body_to_dvl)
    yield from (
        "",
        "# The DVL reads (1 + error) times the velocity; multiply its velocity by the factor.",
    )
    for text in (
        f"scale_error_percent: {_list(100.0 * i.scale_error, 4)}",
        f"scale_error_std_percent: {_list(100.0 * i.scale_std, 4)}",
        f"scale_error_ppm: {_list(1e6 * i.scale_error, 0)}",
        f"scale_error_std_ppm: {_list(1e6 * i.scale_std, 0)}",
        f"scale_factor: {_list(1.0 / (1.0 + i.scale_error), 6)}",
    ):
        yield _line(text, scale)
    yield from ("", f"# From the {i.origin} to the DVL: forward, starboard, down.")
    yield _line(f"lever_arm_m: {_list(i.lever_arm, 4)}", arm)
    yield _line(f"lever_arm_std_m: {_list(i.lever_arm_std, 4)}", arm)
    yield from _trdi(i, angles)
    yield from _makers(i, angles, scale, arm)


def _grades(i: InstrumentTerms) -> tuple[tuple[Grade, ...], ...]:
    """Return the grades of angles, lever arm and scale error."""
    return i.dvl_in_body["ZYX"].grade, i.lever_arm_grade, i.scale_grade


def _trdi(i: InstrumentTerms, grade: Grade) -> Iterator[str]:
    yield from (
        "",
        "# TRDI, 0.01 deg. EA is the direction of beam 3 seen from the ship's bow, positive",
        "# clockwise from above. EI and EJ are roll and pitch of the ship when the instrument is",
        "# level, positive port side up and bow up: Rz(-EA) Ry(EJ) Rx(EI) takes ship to",
        "# instrument. They are valid for a DVL that looks down, if EA, EI and EJ were 0 in the",
        "# trial, and if the body axes are parallel to those of the ship. Sign rules: Pathfinder",
        "# DVL Guide (2018) for EI and EJ, RiverPro and RioPro ADCP Guide (2017) for EA.",
        f"# {RECORDED_AXES[i.axes_as(TRDI_AXES)]}",
    )
    if not looks_down(i.attitude_as(TRDI_AXES)):
        yield _LOOKS_UP
    yield "trdi:"
    for name, value, std in zip(
        ("EA", "EI", "EJ"), i.alignment.tolist(), i.alignment_std.tolist(), strict=True
    ):
        about = f"{_command(name, value)}, ± {fixed(std, 4)} deg"
        yield _line(f"  {name}: {hundredths(value)}", grade, about)


def _makers(i: InstrumentTerms, angles: Grade, scale: Grade, arm: Grade) -> Iterator[str]:
    """Yield the calibration in the conventions of other makers, with their sign rules."""
    roll, pitch, yaw = (float(x) for x in i.dvl_in_body["ZYX"].value)
    water_linked = i.attitude_as(WATER_LINKED_AXES)
    mean = float(np.mean(i.scale_error))
    forward, starboard, down = (float(x) for x in i.lever_arm)
    yield from (
        "",
        "# The following are valid if the settings of the instrument were 0 in the trial.",
        "#",
        "# Nortek: attitude of the DVL in the vehicle, axes forward, starboard, down; yaw first,",
        "# then pitch, then roll; each positive by the right hand about its axis. Sign rule of",
        "# yaw: DVL manual (2017), from the vehicle's forward axis to the DVL's X axis, and",
        "# Signature VM manual, clockwise. The signs of roll and pitch are NOT VERIFIED against a",
        "# manual: check one of them before use.",
        f"# {RECORDED_AXES[i.axes_as(NORTEK_AXES)]}",
        "nortek:",
        _line(f"  roll_pitch_yaw_deg: {_list(i.as_frd.value, 2)}", angles),
        "",
        "# Water Linked: one angle, from the vehicle's forward axis to that of the DVL, positive",
        "# clockwise from above, from 0 to 360 deg; software before 2.2.1 takes whole degrees.",
        "# Sign rule: DVL documentation, page Axes. The DVL has no setting for the angles that",
        "# are left after this offset: enter them in your navigation software; yaw first, then",
        "# pitch, then roll.",
        f"# {RECORDED_AXES[i.axes_as(WATER_LINKED_AXES)]}",
        *(() if looks_down(water_linked) else (_LOOKS_UP,)),
        "water_linked:",
        _line(
            f"  mounting_rotation_offset: {fixed(i.rotation_offset, 2)}",
            i.dvl_in_body["ZYX"].grade[2],
        ),
        _line(f"  roll_pitch_yaw_after_offset_deg: {_list(i.after_offset.value, 2)}", angles),
        "",
        "# Delph-style: axes XV1 forward, XV2 to port, XV3 up: Advanced Configuration User Guide",
        f"# of OCTANS (2015). The lever arm runs from the {i.origin} to the DVL. Heading is",
        "# positive clockwise from above, roll positive port side up, pitch positive bow down.",
        "# The scale factor is what the DVL reads too much, in %. The signs of the angles and of",
        "# the scale factor are NOT VERIFIED against a manual: check one of them before use.",
        "delph:",
        _line(f"  heading_pitch_roll_deg: {_list([yaw, -pitch, roll], 4)}", angles),
        _line(f"  scale_factor_percent: {fixed(100.0 * mean, 4)}", scale),
        _line(f"  lever_arm_xv1_xv2_xv3_m: {_list([forward, -starboard, -down], 4)}", arm),
    )


_LOOKS_UP = "# DO NOT TYPE IN: with these values, the instrument would not look down."


def _angles(by_order: dict[Order, Angles]) -> Iterator[str]:
    for order in ORDERS:
        angles = by_order[order]
        grade = worst(angles.grade)
        yield f"  {order}:                             # {_ORDER_TEXT[order]}"
        yield _line(f"    roll_pitch_yaw_deg: {_list(angles.value, 4)}", grade)
        yield _line(f"    std_deg: {_list(angles.std, 4)}", grade)


def _list(values: Array | Sequence[float], decimals: int) -> str:
    return "[" + ", ".join(fixed(float(v), decimals) for v in values) + "]"


def _command(name: str, angle: float) -> str:
    prefix = "" if name == "EA" else "#"
    return f"{prefix}{name}{hundredths(angle):+06d}"
