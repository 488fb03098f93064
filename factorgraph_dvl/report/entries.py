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
    TransceiverTerms,
)
from factorgraph_dvl.analysis.mount import looks_down
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.notation import at_precision, with_std
from factorgraph_dvl.quality.verdict import Grade
from factorgraph_dvl.report.table import Mark, Table
from factorgraph_dvl.report.tables import GRADES
from factorgraph_dvl.sensors.dvl import MISALIGNMENT

TITLE = "Enter in your DVL"
MOUNT = "Mount, by the axes of the record:"
USBL_TITLE = "Enter in your USBL"
# Why a value must not be entered, by its grade.
REFUSED = {
    "red": "σ is more than twice its limit",
    "grey": "the trial did not determine it",
}
# Makers by words in the name of a maker, and what must be checked before their names are used.
_MAKERS = {
    "TRDI": ("rdi", "rd instruments", "teledyne"),
    "Nortek": ("nortek",),
    "Water Linked": ("water linked", "waterlinked"),
    "Delph": ("exail", "ixblue", "ixsea", "delph"),
}
_AT_ZERO = "The maker's numbers are valid if its settings were 0 in the trial."
_NOT_THESE = "Do not enter red or grey values."
_ONCE = "Enter the angles once: in the DVL or in the navigation software, not in both."
_REMARKS = {
    "TRDI": (_AT_ZERO, _ONCE),
    "Nortek": (
        _AT_ZERO,
        _ONCE,
        "The sign of yaw is the maker's. Those of roll and pitch are assumed: check one before "
        "use.",
    ),
    "Water Linked": (
        _AT_ZERO,
        "Enter the offset in the DVL and the angles after it in the navigation software, or roll, "
        "pitch and yaw there and no offset. The DVL has no setting for scale error and lever arm.",
    ),
    "Delph": (
        _AT_ZERO,
        "The signs of the lever arm are the maker's. Those of the angles are assumed: check one "
        "before use.",
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
_MAKERS_NUMBERS = (
    "instrument.yaml has the numbers as TRDI, Nortek, Water Linked and Exail define them. They "
    "are here too if trial.yaml has certificate: {dvl: {maker: …}}."
)
_NO_ROWS = "The maker's own numbers are not given: with them, the DVL would not look down."
USBL_DEFINITIONS = (
    "Attitude of the transceiver in the ship, ZYX: heading first, then pitch, then roll.",
    "It comes on top of what was set in the USBL, whose own signs may be others.",
)
_MAKER_AXES = {"TRDI": TRDI_AXES, "Nortek": NORTEK_AXES, "Water Linked": WATER_LINKED_AXES}


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


def usbl_entries(t: TransceiverTerms) -> tuple[Entry, ...]:
    """Return roll, pitch, heading of a transceiver and the error of its ranges."""
    words = (
        ("roll_deg", "roll", "deg", "starboard down"),
        ("pitch_deg", "pitch", "deg", "bow up"),
        ("heading_deg", "heading", "deg", "to starboard"),
    )
    angles = t.attitude
    out = [
        Entry(*own, float(value), float(std), grade)
        for own, value, std, grade in zip(
            words, angles.value, angles.std, angles.grade, strict=True
        )
    ]
    if t.range_error is not None:
        value, std = (100.0 * x for x in t.range_error)
        own = ("range_error_percent", "range error", "%", "reads too much")
        out.append(Entry(*own, value, std, t.range_grade[0]))
    return tuple(out)


def usbl_table(t: TransceiverTerms) -> Table:
    """Return the table of what to enter in a USBL, for the terminal and for the page."""
    table = _empty(USBL_TITLE, " ".join((*USBL_DEFINITIONS, _NOT_THESE)))
    for e in usbl_entries(t):
        table.row(e.name, with_std(e.value, e.std), e.unit, e.rule, Mark(e.grade, GRADES[e.grade]))
    return table


def _empty(title: str, caption: str) -> Table:
    """Return a table of entries without rows."""
    table = Table(title=title, caption=caption)
    table.column("quantity")
    table.column("value ± σ", numeric=True)
    table.column("unit")
    table.column("positive")
    table.column("grade")
    return table


def entries_table(i: InstrumentTerms, maker: str | None = None) -> Table:
    """Return the table of what to enter, for the terminal and for the page.

    Parameters
    ----------
    i : InstrumentTerms
        Calibration in the terms of instruments.
    maker : str, optional
        Maker of the DVL, empty if a trial does not state it; where it is known, the table has the
        maker's own names too. By default the numbers are not those of one trial.
    """
    table = _empty(TITLE, " ".join(conventions(i, maker)))
    for e in (entries := entries_of(i)):
        table.row(
            e.name, with_std(e.value, e.std), e.unit, e.rule, Mark(e.grade, GRADES[e.grade]),
            end_section=e is entries[-1],
        )  # fmt: skip
    graded = {e.key: e.grade for e in entries}
    for name, text, unit, rule, of in maker_rows(i, maker or ""):
        grade = worst(graded[key] for key in graded if key.startswith(tuple(of)))
        table.row(name, text, unit, rule, Mark(grade, GRADES[grade]))
    return table


def definitions(i: InstrumentTerms) -> tuple[str, ...]:
    """Return how the angles and the lever arm are defined."""
    return (
        "Attitude of the DVL in the vehicle, ZYX: yaw first, then pitch, then roll.",
        f"Lever arm: from the {i.origin} to the DVL.",
        *([] if looks_down(i.attitude) else [_OTHER_AXES]),
    )


def conventions(i: InstrumentTerms, maker: str | None = None) -> tuple[str, ...]:
    """Return how the numbers are defined, which to enter, and what a maker's own depend on.

    Parameters
    ----------
    i : InstrumentTerms
        Calibration in the terms of instruments.
    maker : str, optional
        Maker of the DVL, as for `entries_table`.
    """
    common = (*definitions(i), _NOT_THESE)
    if maker is None:
        return common
    known = _maker(maker)
    if not known:
        return (*common, _MAKERS_NUMBERS)
    if not maker_rows(i, maker):
        return (*common, _NO_ROWS)
    named = [RECORDED_AXES[i.axes_as(_MAKER_AXES[known])]] if known in _MAKER_AXES else []
    return (*common, *named, *_REMARKS[known])


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
    known = _maker(maker)
    if known == "TRDI" and looks_down(i.attitude_as(TRDI_AXES)):
        signs = ("to starboard", "ship: port up", "ship: bow up")
        stds = 100.0 * i.alignment_std
        return [
            (f"TRDI {name}", f"{hundredths(a)} ± {at_precision(s, s)}", "0.01 deg", rule, angles)
            for name, a, s, rule in zip(("EA", "EI", "EJ"), i.alignment, stds, signs, strict=True)
        ]
    if known == "Nortek":
        rules = ("starboard down", "bow up", "to starboard")
        return [
            (f"Nortek {name}", with_std(a, std), "deg", rule, angles)
            for name, a, std, rule in zip(angles, i.as_frd.value, i.as_frd.std, rules, strict=True)
        ]
    if known == "Water Linked" and looks_down(i.attitude_as(WATER_LINKED_AXES)):
        offset = with_std(i.rotation_offset, i.as_frd.std[2])
        rules = ("starboard down", "bow up", "to starboard")
        left = i.after_offset
        return [
            ("Water Linked mounting rotation offset", offset, "deg", "to starboard", ("yaw",)),
            *(
                (f"after the offset: {name}", with_std(a, std), "deg", rule, angles)
                for name, a, std, rule in zip(angles, left.value, left.std, rules, strict=True)
            ),
        ]
    if known == "Delph":
        turned, arm = i.dvl_in_body["ZYX"], i.lever_arm
        heading, pitch, roll = turned.value[::-1]
        return [
            *(
                (f"Delph {name}", with_std(x, std), "deg", rule, angles)
                for name, x, std, rule in zip(
                    ("heading", "pitch", "roll"), (heading, -pitch, roll), turned.std[::-1],
                    ("to starboard", "bow down", "port side up"), strict=True,
                )
            ),
            *(
                (f"Delph XV{k}", with_std(x, std), "m", rule, ("lever_arm",))
                for k, x, std, rule in zip(
                    (1, 2, 3), (arm[0], -arm[1], -arm[2]), i.lever_arm_std,
                    ("ahead", "to port", "above"), strict=True,
                )
            ),
        ]  # fmt: skip
    return []


def _maker(name: str) -> str:
    """Return the maker that a name means, as rows name it; empty if it is not known."""
    named = name.lower()
    return next((m for m, words in _MAKERS.items() if any(w in named for w in words)), "")


def hundredths(angle: float) -> int:
    """Return an angle, deg, in hundredths within -17999 to 18000."""
    found = round(100.0 * angle)
    return found + 36000 if found <= -18000 else found


def worst(found: Iterable[Grade]) -> Grade:
    """Return the worst of some grades."""
    order: tuple[Grade, ...] = ("green", "orange", "grey", "red")
    return max(found, key=order.index)
