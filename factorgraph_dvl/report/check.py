"""Residuals and dead reckoning before and after calibration: what page and paper say of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

# Names of a row, and its numbers before and after calibration.
Row = tuple[tuple[str, ...], str, str]

TITLE = "Before and after calibration"
SOURCES = {
    "second half": "The calibration is that of the first half of the trial, tested with the data "
    "of the second half.",
    "same data": "The trial gives no calibration to use, or its second half has too few data. So "
    "the calibration is tested with the data that it was estimated from, which makes errors look "
    "smaller.",
}
POSITIONS = {
    "reference": "Positions are compared with the reference.",
    "GNSS": "Positions are compared with GNSS, whose own noise is part of the error.",
    "INS": "Positions are compared with the INS.",
    "nothing": "No positions cover this time.",
}
ATTITUDE = "Attitude and velocity of the vehicle are those of the whole solution."
ERRORS = (
    ("end_point_error_m", "end point error, m"),
    ("end_point_percent", "end point error, % of distance"),
    ("global_error_m", "largest error, m"),
    ("rms_error_m", "RMS error, m"),
    ("distance_m", "distance, m"),
)


def check_texts(check: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return which data were used, and with what they are compared.

    Parameters
    ----------
    check : mapping of str to object
        Content of check.json.
    """
    return SOURCES[check["data"]], ATTITUDE, POSITIONS[check["positions"]]


def check_rows(check: Mapping[str, Any]) -> Iterator[Row]:
    """Yield residuals of each axis, and the errors of the tracks where they are known."""
    rms = check["residual_rms_m_s"]
    for axis, before, after in zip(rms["axes"], rms["before"], rms["after"], strict=True):
        yield ("RMS residual of the DVL, m/s:", axis), number(before), number(after)
    found = check["dead_reckoning"]
    if "end_point_error_m" in found:
        yield from error_rows(found)


def error_rows(found: Mapping[str, Any]) -> Iterator[Row]:
    """Yield the errors of two tracks.

    Parameters
    ----------
    found : mapping of str to object
        Errors after calibration, and under `uncalibrated` those before it.
    """
    before = found.get("uncalibrated", {})
    for key, name in ERRORS:
        yield (name,), number(before.get(key)), number(found.get(key))


def number(value: Any) -> str:
    """Return a number as text; a dash where it is not known."""
    return "–" if value is None else f"{value:.4g}"
