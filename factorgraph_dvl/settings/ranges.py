"""What physical quantities can be: hard limits, by the names that settings and tables share.

The name of a setting, a column or a calibration parameter states its unit, and so its range:
the first line of the table that its name ends on. Whether 0 is allowed, or a number must be
above -1, is for the settings to say; narrower limits of one column stand with its sensor.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple


class Range(NamedTuple):
    """Smallest and largest value of a quantity, in its unit."""

    low: float
    high: float
    unit: str

    def holds(self, value: float) -> bool:
        """Whether a value lies within; nan, which stands for a missing one, does."""
        return not (value < self.low or value > self.high)

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g} {self.unit}".rstrip()


# A clock that is off by more than a day is another clock.
_DAY_S = 86400.0
_VALUES = {
    "lat_deg": Range(-90.0, 90.0, "deg"),
    "lon_deg": Range(-360.0, 360.0, "deg"),
    "turn_deg": Range(-36e3, 36e3, "deg"),
    "angle_deg": Range(-36e3, 36e3, "deg"),
    "deg": Range(-360.0, 360.0, "deg"),
    "deg_s": Range(-3600.0, 3600.0, "deg/s"),
    "deg_h": Range(-1e6, 1e6, "deg/h"),
    "ug": Range(-1e7, 1e7, "µg"),
    "height_m": Range(-12e3, 100e3, "m"),
    "depth_m": Range(-100.0, 12e3, "m"),
    "lever_arm_m": Range(-1e3, 1e3, "m"),
    "amplitude_m": Range(-100.0, 100.0, "m"),
    "m": Range(-1e7, 1e7, "m"),
    "m_s": Range(-1e3, 1e3, "m/s"),
    "m_s2": Range(-1e3, 1e3, "m/s²"),
    "rad_s": Range(-100.0, 100.0, "rad/s"),
    "hz": Range(1e-15, 1e5, "Hz"),
    **dict.fromkeys(("straight_s", "duration_s", "stop_s", "ramp_s"), Range(0.0, 1e7, "s")),
    "offset_s": Range(-_DAY_S, _DAY_S, "s"),
    # Seconds since 1970 or 1980 are times, too.
    "s": Range(-1e10, 1e10, "s"),
    "scale_error": Range(-10.0, 10.0, ""),
    "sound_speed_error": Range(-1.0, 1.0, ""),
    "ppm": Range(-1e6, 1e6, "ppm"),
    **dict.fromkeys(("qw", "qx", "qy", "qz"), Range(-2.0, 2.0, "")),
    **dict.fromkeys(
        (*("body_x", "body_y", "body_z"), *("inertial_x", "inertial_y", "inertial_z")),
        Range(-1e6, 1e6, ""),
    ),
    "directions": Range(-2.0, 2.0, ""),
    "stars": Range(-1e6, 1e6, ""),
}
# A standard deviation is 0 where its key allows that. One that is too small for the squares
# of its inverse is a slip of the unit, as is one beyond all that is known anyway.
_LEAST_STD = 1e-12
_STD = {
    "deg": 1e4,
    "arcsec": 1e7,
    "deg_sqrt_h": 1e4,
    "deg_h": 1e6,
    "deg_h_sqrt_h": 1e6,
    "deg_h_g": 1e6,
    "ppm": 1e6,
    "ug": 1e7,
    "ug_sqrt_hz": 1e7,
    "ug_sqrt_h": 1e7,
    "lever_arm_m": 1e4,
    "m": 1e8,
    "m_s": 1e4,
    "s": 1e10,
    "fraction": 10.0,
    "error": 1e3,
    "sqrt_h": 1e3,
}
_UNITS = {
    **{"deg_sqrt_h": "deg/√h", "deg_h": "deg/h", "deg_h_sqrt_h": "deg/h/√h", "ug": "µg"},
    "deg_h_g": "deg/h/g",
    **{"ug_sqrt_hz": "µg/√Hz", "ug_sqrt_h": "µg/√h", "m_s": "m/s", "lever_arm_m": "m"},
    **{"fraction": "", "error": "", "sqrt_h": "1/√h"},
}
_SPREADS = frozenset({"std", "noise", "walk"})


def is_spread(name: str) -> bool:
    """Whether a name is that of a standard deviation, a noise density or a random walk."""
    return not _SPREADS.isdisjoint(name.split("_"))


def range_of(name: str) -> Range | None:
    """Return the range of a quantity by its name, None if the name states none."""
    parts = name.split("_")
    if is_spread(name):
        # `lever_arm_std_m`, `std_e_m` and `scale_error_std` state their units anywhere.
        parts = [part for part in parts if part not in _SPREADS]
        unit = _longest(parts, _STD)
        return None if unit is None else Range(0.0, _STD[unit], _UNITS.get(unit, unit))
    unit = _longest(parts, _VALUES)
    return None if unit is None else _VALUES[unit]


SWAPPED = "Latitude and longitude seem to be swapped"


def could_be_longitude(name: str, value: float) -> bool:
    """Return whether a latitude that cannot be one would be a longitude."""
    return name.endswith("lat_deg") and 90.0 < abs(value) <= 360.0


def _longest(parts: list[str], known: Mapping[str, object]) -> str | None:
    tails = ("_".join(parts[i:]) for i in range(len(parts)))
    return next((tail for tail in tails if tail in known), None)


def out_of_range(name: str, values: Iterable[float]) -> str:
    """Return what is wrong with values of a quantity, empty if they are possible."""
    limits = range_of(name)
    for value in values:
        if not math.isfinite(value):
            return f"`{name}` must be finite"
        if limits is not None and not limits.holds(value):
            swapped = f". {SWAPPED}" if could_be_longitude(name, value) else ""
            return f"`{name}` must be {limits}, not {value:g}{swapped}"
        if is_spread(name) and 0.0 < value < _LEAST_STD:
            return f"`{name}` must be {_LEAST_STD:g} or more, or 0, not {value:g}"
    return ""
