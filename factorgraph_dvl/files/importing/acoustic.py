"""Fixes of a vehicle under water: its place relative to a vessel, whose position is known."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np

from factorgraph_dvl.files.formats.format import KINDS, Kind, empty
from factorgraph_dvl.files.formats.framing import Records
from factorgraph_dvl.files.importing.decisions import Decisions
from factorgraph_dvl.files.importing.merging import Beside, Merged, merge
from factorgraph_dvl.files.importing.positions import STD_BY_QUALITY, UNKNOWN_STD
from factorgraph_dvl.files.importing.spool import Spool, Stream
from factorgraph_dvl.files.importing.time_base import Timed
from factorgraph_dvl.geometry.earth import radii
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array

# Formats beside whose places sentences of GNSS and compass are the vessel's.
_BESIDE_SENTENCES = ("usbl-sentences", "table")
_SENTENCES = "nmea"
# Chosen: of a true heading by GNSS or a gyrocompass that states none.
_HEADING_STD = 1.0 * DEG
# Chosen: time between records of the vessel, s, beyond which it is not known where it was.
_LONGEST_STEP = 5.0
# Share of the stated errors of fixes that is new in each, if they are independent. Chosen.
_SMOOTH = 0.3


def located(
    streams: Sequence[Timed],
    spool: Spool,
    decisions: Decisions,
    whose: Mapping[str, Kind] | None = None,
) -> list[Timed]:
    """Replace places relative to a vessel by fixes.

    p = p_vessel + Rz(heading) place. The variance of a fix is that of the place, plus that of the
    vessel's position, plus that of its heading times the squared distance.

    Parameters
    ----------
    streams : sequence of Timed
        Streams of all kinds.
    spool : Spool
        Takes the fixes.
    decisions : Decisions
        Takes what was done.
    whose : mapping of str to Kind, optional
        Whose the positions in files are, by patterns of their names.

    Returns
    -------
    list of Timed
        Without the kind `acoustic`; with `topside`, whose motion is not that of the vehicle, only
        beside a transceiver.
    """
    streams = _with_vessel(streams, decisions, whose or {})
    streams = _of_one_transponder(streams, decisions)
    raw = any(t.stream.kind == "transceiver" for t in streams)
    left_out = ("acoustic",) if raw else ("acoustic", "topside")
    others = [t for t in streams if t.stream.kind not in left_out]
    vessel = [timed for timed in streams if timed.stream.kind == "topside"]
    places = merge([t for t in streams if t.stream.kind == "acoustic"], decisions)
    if places is None:
        for timed in () if raw else vessel:
            decisions.add(
                timed.stream.label, "of a vessel, and no file has places relative to it → not used"
            )
        return others
    position = of_vessel(streams, ("lat",), decisions)
    heading = of_vessel(streams, ("heading",), decisions)
    used = [t for part in (position, heading) if part is not None for t in part.streams]
    for timed in vessel:
        if timed not in used:
            decisions.add(timed.stream.label, "of the vessel, not used: another one has more")
    if position is None or heading is None:
        lack = "position" if position is None else "heading"
        decisions.warn(
            f"{places.label}: no file has the {lack} of the vessel → relative places are not used"
        )
        return others
    decisions.add(
        places.label,
        f"relative to the vessel, whose position is that of {position.label} and whose heading "
        f"that of {heading.label} → fixes of the vehicle, heights below the surface",
        "usbl.file",
    )
    first = places.streams[0].stream
    times: list[Array] = []
    changes: list[Array] = []
    stated: list[Array] = []

    def parts() -> Iterator[Records]:
        for time, fixes in _fixes(places, Beside(position), Beside(heading)):
            times.append(time)
            changes.append(_changes_of_error(time, fixes))
            stated.append(fixes["std"][:, 0])
            yield fixes

    records = spool.store(parts(), KINDS["transponder"])
    _judge(places.label, np.concatenate(changes), np.concatenate(stated), decisions)
    stream = Stream(
        first.file, first.format, "transponder", "utc", first.stream, "", "unknown", (), records
    )
    return [*others, Timed.of(stream, times, spool)]


def _changes_of_error(time: Array, fixes: Records) -> Array:
    """Return how far fixes are from the middle of their neighbours, north and east, (M, 2), m.

    Times a factor that makes it the standard deviation of errors that are new in each fix. Only
    where the fixes before and after are near in time: so the motion adds hardly anything.
    """
    meridian, transverse = radii(fixes["lat"])
    east = fixes["lon"] * transverse * np.cos(fixes["lat"])
    place = np.stack([fixes["lat"] * meridian, east], axis=1)
    near = (np.diff(time)[1:] < _LONGEST_STEP) & (np.diff(time)[:-1] < _LONGEST_STEP)
    return np.diff(place, 2, axis=0)[near] / np.sqrt(6.0)


def _judge(label: str, changes: Array, stated: Array, decisions: Decisions) -> None:
    """Say how much of the stated errors of fixes is new in each of them."""
    changes, stated = (x[np.isfinite(x)] for x in (changes, stated))
    if not (changes.size and stated.size):
        return
    # Of a Gaussian, the median of the size is 0.6745 σ.
    found, std = float(np.median(np.abs(changes))) / 0.6745, float(np.median(stated))
    text = f"from one fix to the next, errors differ by {found:.2g} m; stated are {std:.2g} m"
    if found < _SMOOTH * std:
        text += (
            " → smoothed, or errors that last; a DVL and attitude of that time would show which"
        )
    decisions.add(label, text, "usbl.position_std_m")


def _with_vessel(
    streams: Sequence[Timed], decisions: Decisions, whose: Mapping[str, Kind]
) -> list[Timed]:
    """Return streams with fixes and headings as those of whom they are.

    Beside places of a USBL, those in sentences are the vessel's, if nothing else is stated.
    """
    beside = any(
        t.stream.format in _BESIDE_SENTENCES and t.stream.kind in ("acoustic", "transceiver")
        for t in streams
    )
    out = []
    for timed in streams:
        stream = timed.stream
        kind = next((k for name, k in whose.items() if fnmatchcase(stream.file, name)), None)
        text = "as the mapping states"
        if kind is None and beside and stream.format == _SENTENCES:
            kind, text = "topside", "beside places of a USBL"
        if kind == "topside" and stream.kind in ("fix", "attitude"):
            decisions.add(stream.label, f"{text} → position or heading of the ship")
            records = stream.records.converted(_as_topside)
            timed = replace(timed, stream=replace(stream, kind=kind, records=records))
        elif kind == "transponder" and stream.kind == "fix":
            decisions.add(stream.label, f"{text} → positions of the vehicle under water")
            timed = replace(timed, stream=replace(stream, kind=kind))
        out.append(timed)
    return out


def _as_topside(records: Records) -> Records:
    out = empty("topside", len(records))
    for name in set(out.dtype.names or ()) & set(records.dtype.names or ()):
        out[name] = records[name]
    return out


def _of_one_transponder(streams: Sequence[Timed], decisions: Decisions) -> list[Timed]:
    """Return streams without the positions of other transponders than the one most often seen."""
    under = [
        t
        for t in streams
        if t.stream.format in _BESIDE_SENTENCES and t.stream.kind in ("acoustic", "transponder")
    ]
    names = {t.stream.stream for t in under}
    if len(names) < 2:
        return list(streams)
    counts = {n: sum(t.known for t in under if t.stream.stream == n) for n in names}
    best = max(sorted(counts), key=lambda name: counts[name])
    others = ", ".join(f"{name} ({counts[name]})" for name in sorted(counts) if name != best)
    decisions.add(best, f"{counts[best]} positions; other transponders left out: {others}")
    return [t for t in streams if t not in under or t.stream.stream == best]


def of_vessel(
    streams: Sequence[Timed], names: Sequence[str], decisions: Decisions
) -> Merged | None:
    """Return the most records of the vessel that have some fields, None without."""
    known = [
        t
        for t in streams
        if t.stream.kind == "topside"
        and all(np.isfinite(t.stream.records[:1000][name]).any() for name in names)
    ]
    if not known:
        return None
    return merge([max(known, key=lambda t: t.known)], decisions)


def _fixes(places: Merged, position: Beside, heading: Beside) -> Iterator[tuple[Array, Records]]:
    for time, part in places.chunks():
        out = empty("transponder", len(part))
        for name in ("at", "received"):
            out[name] = part[name]
        out["time"] = time
        vessel_time, vessel = position.around(time)
        lat, lon = (between(time, vessel_time, vessel[name]) for name in ("lat", "lon"))
        heading_time, headings = heading.around(time)
        known = np.isfinite(headings["heading"])
        psi = between(time, heading_time[known], np.unwrap(headings["heading"][known]))
        forward, starboard, down = part["place"].T
        north = forward * np.cos(psi) - starboard * np.sin(psi)
        east = forward * np.sin(psi) + starboard * np.cos(psi)
        meridian, transverse = radii(lat)
        out["lat"] = lat + north / meridian
        out["lon"] = lon + east / (transverse * np.cos(lat))
        out["altitude"] = -down
        surface = _level(vessel_time, vessel["quality"], time)
        own = np.where(np.isfinite(part["std"]), part["std"], UNKNOWN_STD)
        swing = _HEADING_STD * np.hypot(forward, starboard)
        horizontal = np.sqrt(own**2 + surface**2 + swing**2)
        out["std"] = np.stack([horizontal, horizontal, own], axis=1)
        yield time, out


def between(time: Array, known: Array, values: Array) -> Array:
    """Return values at times, linear between records that are not far apart, else nan."""
    use = np.isfinite(values)
    known, values = known[use], values[use]
    if len(known) < 2:
        return np.full(len(time), np.nan)
    place = np.clip(np.searchsorted(known, time), 1, len(known) - 1)
    inside = (time >= known[0]) & (time <= known[-1])
    near = inside & (known[place] - known[place - 1] < _LONGEST_STEP)
    return np.where(near, np.interp(time, known, values), np.nan)


def _level(known: Array, quality: Array, time: Array) -> Array:
    """Return the standard deviation of the vessel's position at times, m, by its quality."""
    level = np.full(len(quality), UNKNOWN_STD)
    for value, std in STD_BY_QUALITY.items():
        level[quality == value] = std
    if not len(known):
        return np.full(len(time), UNKNOWN_STD)
    return level[np.clip(np.searchsorted(known, time), 0, len(known) - 1)]
