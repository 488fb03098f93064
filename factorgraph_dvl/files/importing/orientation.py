"""The attitude record of a trial: which instrument, true or magnetic, with which errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from factorgraph_dvl.files.importing.decisions import Decisions
from factorgraph_dvl.files.importing.merging import SAMPLE, Merged, merge
from factorgraph_dvl.files.importing.positions import best_source
from factorgraph_dvl.files.importing.time_base import FIRST_DATE, Timed
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array

# Chosen, typical of instruments: total σ of roll, pitch and heading, deg, and the prior of a
# constant offset of the heading, deg. Magnetic compasses on boats deviate by some degrees that
# change with the heading; where the declination is not known it may be as large as this.
_TRUE = ((0.1, 0.1, 0.3), 0.0)
_MAGNETIC_STD = (0.5, 0.5, 2.0)
_CORRECTED_OFFSET, _MAGNETIC_OFFSET, _DEVIATION = 10.0, 40.0, 5.0
# Where nothing says which north a heading counts from. Chosen: as a magnetic one.
_UNKNOWN = ((0.5, 0.5, 2.0), 45.0)
# Chosen: the greater the better.
_RANKS = {"true": 2, "unknown": 1, "magnetic": 0}
# Stream of the sensors in a DVL itself.
OWN = "leader"


@dataclass(frozen=True)
class ImportedAttitude:
    """Roll, pitch and heading, and what is known of their errors.

    Parameters
    ----------
    attitude : Merged
        Attitude in order.
    tilt : bool
        Whether there are roll and pitch.
    declination : float, rad
        Declination to add to headings.
    std : tuple of float, deg
        Total σ of roll, pitch, heading.
    offset_std : float, deg
        Prior of a constant offset of the heading.
    deviation_std : float, deg
        Prior of a deviation that depends on the heading, as of a magnetic compass.
    own : bool
        Whether it is that of the sensors in the DVL.
    """

    attitude: Merged
    tilt: bool
    declination: float
    std: tuple[float, float, float]
    offset_std: float
    deviation_std: float
    own: bool

    def tables(self, epoch: float) -> Iterator[dict[str, Array]]:
        """Yield parts of the table `attitude`."""
        for time, part in self.attitude.chunks():
            names = ("roll", "pitch") if self.tilt else ()
            good = np.isfinite(part["heading"])
            for name in names:
                good &= np.isfinite(part[name])
            heading = (part["heading"] + self.declination) / DEG % 360.0
            yield {
                "time_s": (time - epoch)[good],
                **{f"{name}_deg": part[name][good] / DEG for name in names},
                "heading_deg": heading[good],
            }


def choose(
    streams: Sequence[Timed], where: tuple[float, float] | None, decisions: Decisions
) -> ImportedAttitude | None:
    """Return the best attitude of all files, None if there is none.

    Parameters
    ----------
    streams : sequence of Timed
        Streams of all kinds.
    where : tuple of float or None, rad
        Latitude and longitude of the trial, for the declination.
    decisions : Decisions
        Takes what was chosen, and why.
    """
    known = [t for t in streams if t.stream.kind != "attitude" or _has_heading(t)]
    attitude = merge(best_source(known, ("attitude",), _rank, decisions), decisions)
    if attitude is None:
        return None
    stream = attitude.streams[0].stream
    part = attitude.sample
    tilt = bool(np.isfinite(part["roll"]).mean() > 0.5)
    declination = 0.0
    std, offset = _TRUE if stream.heading == "true" else _UNKNOWN
    if stream.heading == "magnetic":
        std, offset = _MAGNETIC_STD, _MAGNETIC_OFFSET
        found = _declination_set(streams, attitude, decisions)
        if found is None:
            time = float(np.median(attitude.sample_time))
            found = _declination(where, time, attitude.label, decisions)
        if found is not None:
            declination, offset = found, _CORRECTED_OFFSET
    elif stream.heading == "unknown":
        decisions.add(
            attitude.label,
            f"the file does not say what headings refer to → offset of the heading estimated, "
            f"± {offset:.0f}°",
            "attitude.heading_offset_std_deg",
        )
    stated = np.asarray(part["std"]) / DEG
    if np.isfinite(stated).all(axis=0).all():
        roll, pitch, heading = np.median(stated, axis=0).tolist()
        std = (roll, pitch, heading)
    what = "roll, pitch and heading" if tilt else "heading alone"
    decisions.add(attitude.label, f"{attitude.count} records of {what}", "attitude.file")
    deviation = _DEVIATION if stream.heading == "magnetic" else 0.0
    own = stream.stream == OWN
    return ImportedAttitude(attitude, tilt, declination, std, offset, deviation, own)


def _declination_set(
    streams: Sequence[Timed], attitude: Merged, decisions: Decisions
) -> float | None:
    """Return the declination that was set for the files of an attitude, rad, None without."""
    settings = [t.stream for t in streams if t.stream.kind == "settings"]
    files = {t.stream.file.casefold() for t in attitude.streams}
    named = [s for s in settings if s.stream.casefold() in files] or settings
    values = {float(s.records[:1]["declination"][0]) for s in named}
    if len(values) > 1:
        decisions.add(
            attitude.label, "several magnetic variations were set, none for it → none is used"
        )
    if len(values) != 1:
        return None
    (value,) = values
    decisions.add(
        attitude.label,
        f"magnetic headings; the variation that was set, {value / DEG:+.2f}° → added; the rest, a "
        "deviation of the compass, is estimated as an offset",
        "attitude.heading_offset_std_deg",
    )
    return value


def _has_heading(timed: Timed) -> bool:
    return bool(np.isfinite(timed.stream.records[:SAMPLE]["heading"]).any())


def _rank(source: Sequence[Timed]) -> tuple[float, ...]:
    part = source[0].stream.records[:SAMPLE]
    tilt = bool(np.isfinite(part["roll"]).any())
    count = sum(timed.known for timed in source)
    return (_RANKS[source[0].stream.heading], float(tilt), float(count))


def _declination(
    where: tuple[float, float] | None, time: float, label: str, decisions: Decisions
) -> float | None:
    """Return the magnetic declination, rad, None where it cannot be had."""
    key = "attitude.heading_offset_std_deg"
    if where is None or time < FIRST_DATE:
        why = "no position" if where is None else "no date"
        decisions.add(
            label,
            f"magnetic headings, and {why} to look up the declination → offset estimated",
            key,
        )
        return None
    if find_spec("pygeomag") is None:
        decisions.add(
            label,
            "magnetic headings; declination not applied, as pygeomag is not installed "
            "(pip install 'factorgraph-dvl[import]') → offset estimated",
            key,
        )
        return None
    value, model = declination(where[0], where[1], time)
    decisions.add(
        label,
        f"magnetic headings; declination {value / DEG:+.2f}° ({model}) → added; the rest, a "
        "deviation of the compass, is estimated as an offset",
        key,
    )
    return value


def declination(lat: float, lon: float, time: float) -> tuple[float, str]:
    """Return the declination by the World Magnetic Model of that time, rad, and the model's name.

    Parameters
    ----------
    lat, lon : float, rad
        Position.
    time : float, s
        UTC since 1970.
    """
    import pygeomag

    year = decimal_year(time)
    folder = Path(pygeomag.__file__).parent / "wmm"
    # The models are named by the year in which they begin; each is for five years.
    begins = sorted(int(name.stem[4:8]) for name in folder.glob("WMM_20??.COF"))
    first = max((begin for begin in begins if begin <= year), default=begins[0])
    model = pygeomag.GeoMag(coefficients_file=f"wmm/WMM_{first}.COF")
    found = model.calculate(lat / DEG, lon / DEG, 0.0, year, allow_date_outside_lifespan=True)
    return float(found.d) * DEG, f"WMM{first}"


def decimal_year(time: float) -> float:
    """Return the year and the part of it that has passed, of UTC, seconds since 1970."""
    when = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=time)
    begin = datetime(when.year, 1, 1, tzinfo=UTC)
    length = datetime(when.year + 1, 1, 1, tzinfo=UTC) - begin
    return when.year + (when - begin) / length
