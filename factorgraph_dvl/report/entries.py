"""What to enter in a DVL: mounting angles, scale error and lever arm, described once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.analysis.instrument_terms import (
    NORTEK_AXES,
    TRDI_AXES,
    WATER_LINKED_AXES,
    InstrumentTerms,
    euler,
)
from factorgraph_dvl.analysis.mount import looks_down
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.notation import at_precision, fixed, with_std
from factorgraph_dvl.quality.verdict import Grade
from factorgraph_dvl.report.table import Mark, Table
from factorgraph_dvl.report.tables import GRADES
from factorgraph_dvl.sensors.dvl import MISALIGNMENT

TITLE = "Enter in your DVL"
# Why a value must not be entered, by its grade.
REFUSED = {
    "red": "σ is more than twice its limit",
    "grey": "the trial did not determine it",
}
# What must be checked before the names of a maker are used, by the first word of them.
_AT_ZERO = "The maker's numbers are valid if its settings were 0 in the trial."
_REMARKS = {
    "TRDI": (_AT_ZERO,),
    "Nortek": (
        "The maker's manuals confirm the sign of yaw. Those of roll and pitch are assumed: check "
        "one before use.",
    ),
    "Water": (_AT_ZERO,),
    "Delph": (
        "The maker's manual confirms the signs of the lever arm. Those of the angles are assumed: "
        "check one before use.",
    ),
}
# How a maker's numbers name the axes x, y, z of the record.
RECORDED_AXES = {
    "RFU": "The axes x, y, z of the record are taken as starboard, forward, up of the DVL.",
    "FRD": "The axes x, y, z of the record are taken as forward, starboard, down of the DVL.",
    "FLU": "The axes x, y, z of the record are taken as forward, port, up of the DVL.",
}
_OTHER_AXES = (
    "With its axes named as those of the body, the DVL would not look down: the angles contain "
    "the turn between the axes of the two instruments."
)
_MAKER_AXES = {"TRDI": TRDI_AXES, "Nortek": NORTEK_AXES, "Water": WATER_LINKED_AXES}


@dataclass(frozen=True)
class Entry:
    """A number to enter.

    Parameters
    ----------
    key : str
        Name with unit, as in `instrument.yaml`.
    name, unit : str
        Name and unit as people read them.
    rule : str
        What a positive number means.
    value, std : float
        Value and standard deviation in `unit`.
    grade : Grade
        Red and grey values must not be entered.
    """

    key: str
    name: str
    unit: str
    rule: str
    value: float
    std: float
    grade: Grade

    @property
    def text(self) -> str:
        """The value to the second digit of its standard deviation."""
        return at_precision(self.value, self.std)


def entries_of(i: InstrumentTerms) -> tuple[Entry, ...]:
    """Return roll, pitch, yaw, the scale errors and the lever arm, each with its sign rule."""
    angles = i.dvl_in_body["ZYX"]
    axes = ("",) if i.scale_error.size == 1 else ("_x", "_y", "_z")
    words = (
        ("roll_deg", "roll", "deg", "starboard down"),
        ("pitch_deg", "pitch", "deg", "bow up"),
        ("yaw_deg", "yaw", "deg", "to starboard"),
        *(
            (f"scale_error{axis}_percent", f"scale error{axis.replace('_', ' ')}", "%",
             "reads too much")
            for axis in axes
        ),
        ("lever_arm_forward_m", "lever arm forward", "m", "ahead"),
        ("lever_arm_starboard_m", "lever arm starboard", "m", "to starboard"),
        ("lever_arm_down_m", "lever arm down", "m", "below"),
    )  # fmt: skip
    value = np.concatenate([angles.value, 100.0 * i.scale_error, i.lever_arm])
    std = np.concatenate([angles.std, 100.0 * i.scale_std, i.lever_arm_std])
    graded = (*angles.grade, *i.scale_grade, *i.lever_arm_grade)
    return tuple(
        Entry(*own, float(v), float(s), grade)
        for own, v, s, grade in zip(words, value, std, graded, strict=True)
    )


def entries_table(i: InstrumentTerms, maker: str = "") -> Table:
    """Return the table of what to enter, for the terminal and for the page.

    Parameters
    ----------
    i : InstrumentTerms
        Calibration in the terms of instruments.
    maker : str, optional
        Maker of the DVL; where it is known, the table has the maker's own names too.
    """
    table = Table(title=TITLE, caption=" ".join(conventions(i, maker)))
    table.column("quantity")
    table.column("value ± σ", numeric=True)
    table.column("unit")
    table.column("positive")
    table.column("grade")
    for e in (entries := entries_of(i)):
        table.row(
            e.name, with_std(e.value, e.std), e.unit, e.rule, Mark(e.grade, GRADES[e.grade]),
            end_section=e is entries[-1],
        )  # fmt: skip
    graded = {e.key: e.grade for e in entries}
    for name, text, unit, rule, of in maker_rows(i, maker):
        grade = worst(graded[key] for key in graded if key.startswith(tuple(of)))
        table.row(name, text, unit, rule, Mark(grade, GRADES[grade]))
    return table


def conventions(i: InstrumentTerms, maker: str = "") -> tuple[str, ...]:
    """Return how angles and lever arm are defined, and which values must not be entered.

    Parameters
    ----------
    i : InstrumentTerms
        Calibration in the terms of instruments.
    maker : str, optional
        Maker of the DVL: what must be checked before its own names are used comes last.
    """
    known = next((name.split()[0] for name, *_ in maker_rows(i, maker)), "")
    named = i.axes_as(_MAKER_AXES[known]) if known in _MAKER_AXES else None
    return (
        "Attitude of the DVL in the vehicle, ZYX: yaw first, then pitch, then roll.",
        "Do not enter red or grey values.",
        f"Lever arm: from the {i.origin} to the DVL.",
        *([] if looks_down(i.attitude) else [_OTHER_AXES]),
        *([] if named is None else [RECORDED_AXES[named]]),
        *_REMARKS.get(known, ()),
    )


def sum_with_compass(findings: Iterable[Finding]) -> Finding | None:
    """Return the finding that data determine only the sum of mount and compass, if there is one.

    It comes before the values: yaw alone is as uncertain as the stated error of the heading.
    """
    return next(
        (f for f in findings if f.code == Code.HEADING_ERROR and f.parameter == MISALIGNMENT), None
    )


def maker_rows(i: InstrumentTerms, maker: str) -> list[tuple[str, str, str, str, Sequence[str]]]:
    """Return what a maker calls the numbers: name, number, unit, sign rule, entries they are from.

    Parameters
    ----------
    i : InstrumentTerms
        Calibration in the terms of instruments.
    maker : str
        Maker as a certificate names it; there are no rows for a maker that is not known.
    """
    angles = ("roll", "pitch", "yaw")
    clockwise = "clockwise from above"
    known = maker.lower()
    is_trdi = any(name in known for name in ("trdi", "rdi", "teledyne"))
    if is_trdi and looks_down(i.attitude_as(TRDI_AXES)):
        rules = (clockwise, "ship: port side up", "ship: bow up")
        return [
            (f"TRDI {name}", f"{hundredths(float(a))}", "0.01 deg", rule, angles)
            for name, a, rule in zip(("EA", "EI", "EJ"), i.alignment, rules, strict=True)
        ]
    if "nortek" in known:
        rules = ("starboard down", "bow up", "to starboard")
        values = euler(i.attitude_as(NORTEK_AXES), "ZYX").tolist()
        return [
            (f"Nortek {name}", fixed(a, 2), "deg", rule, angles)
            for name, a, rule in zip(angles, values, rules, strict=True)
        ]
    is_water_linked = any(name in known for name in ("water linked", "waterlinked"))
    if is_water_linked and looks_down(i.attitude_as(WATER_LINKED_AXES)):
        name, offset = "Water Linked mounting_rotation_offset", fixed(i.rotation_offset, 2)
        return [(name, offset, "deg", clockwise, ("yaw",))]
    if any(name in known for name in ("exail", "ixblue", "delph")):
        roll, pitch, yaw = (float(x) for x in i.dvl_in_body["ZYX"].value)
        forward, starboard, down = (float(x) for x in i.lever_arm)
        arm = (("XV1", forward, "ahead"), ("XV2", -starboard, "to port"), ("XV3", -down, "above"))
        return [
            ("Delph heading", fixed(yaw, 2), "deg", clockwise, angles),
            ("Delph pitch", fixed(-pitch, 2), "deg", "bow down", angles),
            ("Delph roll", fixed(roll, 2), "deg", "port side up", angles),
            *((f"Delph {name}", fixed(x, 3), "m", rule, ("lever_arm",)) for name, x, rule in arm),
        ]
    return []


def hundredths(angle: float) -> int:
    """Return an angle, deg, in hundredths within -17999 to 18000."""
    found = round(100.0 * angle)
    return found + 36000 if found <= -18000 else found


def worst(found: Iterable[Grade]) -> Grade:
    """Return the worst of some grades."""
    order: tuple[Grade, ...] = ("green", "orange", "grey", "red")
    return max(found, key=order.index)
