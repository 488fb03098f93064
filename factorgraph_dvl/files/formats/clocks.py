"""Times as instruments write them, to seconds since 1970-01-01T00:00:00 UTC."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factorgraph_dvl.files.formats.framing import number
from factorgraph_dvl.geometry.units import DAY, MICROSECOND
from factorgraph_dvl.geometry.vectors import Array

# Seconds from 1970 to the start of GPS time, and the days from which GPS time was ahead
# of UTC by 1, 2, ... seconds (IERS Bulletin C; none since 2017).
GPS_EPOCH = 315964800.0
_LEAPS = np.array(
    [
        *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01"),
        *("1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01"),
        *("1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
    ],
    dtype="datetime64[s]",
).astype(float)


def seconds_of(text: bytes) -> float:
    """Return a number, or the seconds since 1970 of a date and time, taken as UTC; else nan."""
    value = number(text)
    if math.isnan(value) and b":" in text:
        plain = text.decode("ascii", "replace").replace("/", "-").removesuffix("Z")
        try:
            stamp = np.datetime64(plain.replace(" ", "T"), "us")
        except ValueError:
            return math.nan
        return math.nan if np.isnat(stamp) else float(stamp.astype(np.int64)) * MICROSECOND
    return value


def full_year(year: ArrayLike) -> NDArray[np.int64]:
    """Return four-digit years; of two digits, 80 to 99 are the last century's."""
    year = np.asarray(year, np.int64)
    return np.where(year >= 100, year, np.where(year >= 80, year + 1900, year + 2000))


def posix(
    year: ArrayLike,
    month: ArrayLike,
    day: ArrayLike,
    hour: ArrayLike = 0,
    minute: ArrayLike = 0,
    second: ArrayLike = 0.0,
) -> Array:
    """Return seconds since 1970 of calendar times (N,).

    Parameters
    ----------
    year, month, day, hour, minute : array_like of int, shape (N,) or ()
        Years of two digits are taken as 1980 to 2079.
    second : array_like, shape (N,) or ()
        Seconds of the minute.

    Returns
    -------
    ndarray, shape (N,), s
        Nan where the time does not exist, as an unset clock writes it.
    """
    year, month, day, hour, minute = (
        np.atleast_1d(np.asarray(part, np.int64)) for part in (year, month, day, hour, minute)
    )
    second = np.atleast_1d(np.asarray(second, float))
    year = full_year(year)
    exists = (year >= 1980) & (year < 2200) & (month >= 1) & (month <= 12) & (day >= 1)
    exists = exists & (hour >= 0) & (hour < 24) & (minute >= 0) & (minute < 60)
    exists = exists & (second >= 0.0) & (second < 61.0)
    months = np.where(exists, (year - 1970) * 12 + month - 1, 0).astype("datetime64[M]")
    after = months + np.timedelta64(1, "M")
    length = after.astype("datetime64[D]") - months.astype("datetime64[D]")
    exists = exists & (day <= length.astype(np.int64))
    midnight = months.astype("datetime64[s]").astype(float) + (np.where(exists, day, 1) - 1) * DAY
    return np.where(exists, midnight + hour * 3600.0 + minute * 60.0 + second, np.nan)


def nearest_day(second_of_day: ArrayLike, near: ArrayLike) -> Array:
    """Return the times of these seconds of the day that are nearest to `near` (N,)."""
    near = np.asarray(near, float)
    return near + (np.asarray(second_of_day) - near + DAY / 2.0) % DAY - DAY / 2.0


def in_order(second_of_day: Array, date: Array) -> Array:
    """Date a sequence of times of day of which a few have a date.

    Parameters
    ----------
    second_of_day : ndarray, shape (N,), s
        Seconds of the day in the order of their arrival; nan where not known.
    date : ndarray, shape (N,), s
        Start of the day since 1970; nan where it was not given.

    Returns
    -------
    ndarray, shape (N,), s
        Since 1970. The date in force is the last that was given, or the first, plus one day for
        each passage of midnight since. All nan if there is no date.
    """
    out = np.full(len(second_of_day), np.nan)
    at = np.flatnonzero(np.isfinite(second_of_day))
    seconds = second_of_day[at]
    if not np.isfinite(date[at]).any():
        return out
    steps = np.diff(seconds, prepend=seconds[:1])
    days = np.cumsum((steps < -DAY / 2.0).astype(float) - (steps > DAY / 2.0)) * DAY
    dated = np.flatnonzero(np.isfinite(date[at]))
    latest = dated[np.maximum(np.searchsorted(dated, np.arange(len(at)), "right") - 1, 0)]
    out[at] = date[at][latest] - days[latest] + days + seconds
    return out


def gps_to_utc(week: ArrayLike, second: ArrayLike) -> Array:
    """Return UTC, seconds since 1970, of GPS weeks (full count) and seconds of the week."""
    gps = GPS_EPOCH + np.asarray(week, float) * 7.0 * DAY + np.asarray(second, float)
    leaps = np.searchsorted(_LEAPS + np.arange(1, len(_LEAPS) + 1), gps, "right")
    return np.asarray(gps - leaps)


def utc_to_gps(utc: ArrayLike) -> Array:
    """Return GPS time, counted like UTC from 1970, of UTC, seconds since 1970."""
    utc = np.asarray(utc, float)
    return np.asarray(utc + np.searchsorted(_LEAPS, utc, "right"))
