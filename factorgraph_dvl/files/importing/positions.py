"""The GNSS record of a trial: fixes with heights, standard deviations and velocities."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.files.formats.format import FIXES, has_place
from factorgraph_dvl.files.formats.framing import Records
from factorgraph_dvl.files.importing.decisions import Decisions
from factorgraph_dvl.files.importing.merging import SAMPLE, Beside, Merged, merge
from factorgraph_dvl.files.importing.time_base import Timed
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.gnss import (
    POSITION_COLUMNS,
    POSITION_STD_COLUMNS,
    VELOCITY_COLUMNS,
    VELOCITY_STD_COLUMNS,
)

# Chosen, typical of receivers: horizontal standard deviation by the quality in GGA, m (single,
# differential, PPS, fixed and float ambiguities, SBAS), and the vertical one relative to it.
STD_BY_QUALITY = {1: 3.0, 2: 1.0, 3: 1.0, 4: 0.02, 5: 0.3, 9: 1.0}
UNKNOWN_STD, _VERTICAL = 3.0, 2.0
# Quality of what is computed without a receiver, as by a filter.
_ESTIMATED = 6.0
# Chosen: heave of a vessel whose fixes have no height, m.
_HEAVE_STD = 2.0
# Speed, m/s, below which a course is noise. Chosen: three times that of a Doppler velocity.
_SLOWEST = 0.3
# Chosen: of velocities by Doppler, m/s, and how long a receiver's filter correlates them, s.
VELOCITY_STD, VELOCITY_CORRELATION = 0.1, 2.0
# Difference of stamps, s, up to which a course belongs to a fix. Chosen: half of it at 10 Hz.
_TOGETHER = 0.05


@dataclass(frozen=True)
class Positions:
    """Fixes, and courses of the same instants.

    Parameters
    ----------
    fixes : Merged
        Fixes in order.
    courses : Merged or None
        Course and speed over ground.
    height : {'height', 'altitude', ''}
        Which vertical position is used; empty if there is none.
    """

    fixes: Merged
    courses: Merged | None
    height: str

    def tables(self, epoch: float) -> Iterator[dict[str, Array]]:
        """Yield parts of the table `gnss`."""
        beside = None if self.courses is None else Beside(self.courses, _TOGETHER)
        for time, fixes in self.fixes.chunks():
            velocity, velocity_std = np.array(fixes["velocity"]), np.array(fixes["velocity_std"])
            course_time, course_velocity = np.empty(0), np.empty((0, 3))
            if beside is not None:
                course_time, course_velocity = _velocities(*beside.around(time))
            if len(course_time):
                place = np.clip(
                    np.searchsorted(course_time, time), 1, max(len(course_time) - 1, 1)
                )
                place = np.minimum(place, len(course_time) - 1)
                before = np.maximum(place - 1, 0)
                earlier = np.abs(course_time[before] - time) < np.abs(course_time[place] - time)
                nearest = np.where(earlier, before, place)
                same = np.abs(course_time[nearest] - time) <= _TOGETHER
                use = (same & np.isnan(velocity).any(axis=1))[:, None]
                velocity = np.where(use, course_velocity[nearest], velocity)
                velocity_std = np.where(use, [VELOCITY_STD, VELOCITY_STD, np.nan], velocity_std)
            unknown = np.isnan(velocity[:, :2]).any(axis=1)[:, None]
            velocity = np.where(unknown, np.nan, velocity)
            columns = (
                ("time_s",),
                *(POSITION_COLUMNS, POSITION_STD_COLUMNS),
                *(VELOCITY_COLUMNS, VELOCITY_STD_COLUMNS),
            )
            height = fixes[self.height] if self.height else np.zeros(len(fixes))
            place_ = np.column_stack([fixes["lat"] / DEG, _wrapped(fixes["lon"] / DEG), height])
            place_[np.isnan(place_).any(axis=1)] = np.nan
            values = ((time - epoch)[:, None], place_, self._std(fixes), velocity, velocity_std)
            table = {
                name: block[:, i]
                for names, block in zip(columns, values, strict=True)
                for i, name in enumerate(names)
            }
            yield table

    def _std(self, fixes: Records) -> Array:
        """Return standard deviations of positions (M, 3): stated, or by quality."""
        level = np.full(len(fixes), UNKNOWN_STD)
        for quality, std in STD_BY_QUALITY.items():
            level[fixes["quality"] == quality] = std
        up = level * _VERTICAL if self.height else np.full(len(fixes), _HEAVE_STD)
        typical = np.stack([level, level, up], axis=1)
        stated = np.array(fixes["std"])
        return np.where(np.isfinite(stated) & (stated > 0.0), stated, typical)


def _velocities(time: Array, courses: Records) -> tuple[Array, Array]:
    """Return times and velocities (N, 3) of courses and speeds that are no noise."""
    speed, course = courses["speed"], courses["course"]
    v = np.stack([speed * np.sin(course), speed * np.cos(course), np.nan * speed], axis=1)
    good = np.isfinite(v[:, :2]).all(axis=1) & (speed >= _SLOWEST)
    return time[good], v[good]


def choose(streams: Sequence[Timed], decisions: Decisions) -> Positions | None:
    """Return the best positions of all files, None if there are none.

    Parameters
    ----------
    streams : sequence of Timed
        Streams of all kinds.
    decisions : Decisions
        Takes what was chosen, and why.
    """
    fixes = merge(best_source(streams, FIXES, _rank_of_fixes, decisions), decisions)
    if fixes is None:
        return None
    if not any(has_place(part).any() for _, part in fixes.chunks()):
        decisions.add(fixes.label, "no record has a position → not used")
        return None
    courses = merge(best_source(streams, ("course",), _count, decisions), decisions)
    height = _height(fixes, decisions)
    _describe(fixes, courses, decisions)
    return Positions(fixes, courses, height)


def best_source(
    streams: Sequence[Timed], kinds: Sequence[str], rank: object, decisions: Decisions
) -> list[Timed]:
    """Return the streams of the best source of some kinds, from all files."""
    sources: dict[tuple[str, str], list[Timed]] = {}
    for timed in streams:
        if timed.stream.kind in kinds:
            sources.setdefault((timed.stream.format, timed.stream.stream), []).append(timed)
    if not sources:
        return []
    ordered = sorted(sources.values(), key=rank, reverse=True)  # type: ignore[call-overload]
    for other in ordered[1:]:
        decisions.add(
            ", ".join(dict.fromkeys(timed.stream.label for timed in other)),
            f"{kinds[0]} not used: {ordered[0][0].stream.label} is better",
        )
    return ordered[0]


def _count(source: Sequence[Timed]) -> tuple[float, ...]:
    return (float(sum(timed.known for timed in source)),)


def _rank_of_fixes(source: Sequence[Timed]) -> tuple[float, ...]:
    parts = [timed.stream.records[:SAMPLE] for timed in source]
    has_any = any(has_place(part).any() for part in parts)
    is_measured = any((part["quality"] != _ESTIMATED).any() for part in parts)
    has_std = any(np.isfinite(part["std"]).any() for part in parts)
    has_height = any(np.isfinite(part[n]).any() for part in parts for n in ("height", "altitude"))
    ranks = (has_any, is_measured, has_std, has_height)
    return (*map(float, ranks), *_count(source))


def _height(fixes: Merged, decisions: Decisions) -> str:
    part = fixes.sample
    if np.isfinite(part["height"]).mean() > 0.5:
        separations = part["height"] - part["altitude"]
        if np.isfinite(separations).any():
            separation = float(np.nanmedian(separations))
            decisions.add(
                fixes.label,
                f"heights: altitude above the geoid plus its separation ({separation:.1f} m) → "
                "height above the ellipsoid",
            )
        return "height"
    if np.isfinite(part["altitude"]).mean() > 0.5:
        decisions.add(
            fixes.label,
            "altitudes above the geoid, whose separation is not given → taken as heights; this "
            "shifts the whole track up or down, and does not change the calibration",
        )
        return "altitude"
    decisions.add(
        fixes.label,
        f"fixes without heights → height 0 ± {_HEAVE_STD:.0f} m: a vessel at the surface",
        "gnss.file",
    )
    return ""


def _describe(fixes: Merged, courses: Merged | None, decisions: Decisions) -> None:
    part = fixes.sample
    known = np.isfinite(part["std"]).all(axis=1)
    stated = part["quality"][np.isfinite(part["quality"]) & has_place(part)]
    qualities = sorted({int(quality) for quality in stated})
    source = "stated in the file" if known.any() else "typical of the quality of the fix"
    count = sum(int(has_place(found).sum()) for _, found in fixes.chunks())
    text = f"{count} fixes; standard deviations {source}"
    if qualities:
        text += f" (quality {', '.join(map(str, qualities))})"
    decisions.add(fixes.label, text, "gnss.file")
    if courses is not None:
        decisions.add(
            courses.label,
            "course and speed → velocity east and north of the fix of the same instant; not below "
            f"{_SLOWEST} m/s, where a course is noise",
            "gnss.velocity_std_m_s",
        )


def _wrapped(lon: Array) -> Array:
    return (lon + 180.0) % 360.0 - 180.0
