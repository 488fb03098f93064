"""Stamps of all files on one clock, UTC."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.formats.clocks import GPS_EPOCH, gps_to_utc, in_order, nearest_day
from factorgraph_dvl.files.formats.format import FIXES
from factorgraph_dvl.files.importing.decisions import Decisions
from factorgraph_dvl.files.importing.lag import lag_between
from factorgraph_dvl.files.importing.speeds import ground_speed, log_speed, turn_rate
from factorgraph_dvl.files.importing.spool import CHUNK, Spool, Stored, Stream
from factorgraph_dvl.geometry.units import DAY
from factorgraph_dvl.geometry.vectors import Array

# Stamps from here on are dates; before, they count from the start of an instrument.
FIRST_DATE = 1e8
# Receivers report a fix by this much late, s: what two clocks that are compared by it are off.
_LATENCY = 0.5
# Prior where stamps of two files were taken as they are, s. Chosen: computers set by hand.
_UNCOMPARED = 5.0
# Time zones are multiples of this, s.
_ZONE = 900.0
# Chosen: so many pairs say all of an offset, its spread and its drift.
_MOST_PAIRS = 10_000
_WEEK = 7.0 * DAY


@dataclass(frozen=True)
class Timed:
    """A stream with UTC.

    Parameters
    ----------
    stream : Stream
        The records.
    time : Stored
        (N,) UTC since 1970, s, nan where the record has no time; since an arbitrary zero if no
        file has a date.
    blocks : tuple of (float, int)
        Earliest time and first record of each `CHUNK` of records in which one has a time.
    known : int
        Number of records with a time.
    offset_std : float, s
        Standard deviation of what may be left of an offset.
    rate_std : float, ppm
        Standard deviation of what may be left of a rate.
    """

    stream: Stream
    time: Stored
    blocks: tuple[tuple[float, int], ...]
    known: int
    offset_std: float = 0.0
    rate_std: float = 0.0

    @classmethod
    def of(cls, stream: Stream, times: Iterable[Array], spool: Spool, *stds: float) -> Timed:
        """Return a stream with its times, which are written to the spool."""
        time = spool.store(times)
        blocks, known = [], 0
        for number, part in enumerate(time.chunks()):
            part = part[np.isfinite(part)]
            if len(part):
                blocks.append((float(part.min()), number * CHUNK))
                known += len(part)
        return cls(stream, time, tuple(blocks), known, *stds)


@dataclass(frozen=True)
class _Offset:
    """Recording clock of a file minus UTC."""

    value: float
    std: float
    rate_std: float = 0.0


def on_utc(streams: Sequence[Stream], spool: Spool, decisions: Decisions) -> list[Timed]:
    """Relate the clocks of all files to UTC.

    Parameters
    ----------
    streams : sequence of Stream
        Streams of all files.
    spool : Spool
        Takes the times.
    decisions : Decisions
        Takes what was found and done.

    Returns
    -------
    list of Timed
        In the order of `streams`.

    Raises
    ------
    DataError
        If the clock of a file cannot be related to that of the positions.
    """
    near = _some_date(streams)
    dated = {
        id(s): Timed.of(s, _dated(s, near, decisions), spool) for s in streams if s.clock != "own"
    }
    own = {s.file: [t for t in streams if t.file == s.file and t.clock == "own"] for s in streams}
    pairs = {file: _pairs(file, own[file], streams, dated) for file in own if own[file]}

    def precedence(file: str) -> tuple[bool, bool]:
        return len(pairs[file][0]) < 2, not any(s.kind in FIXES for s in own[file])

    # Files that have UTC, then others with positions: the rest is compared with these.
    for file in sorted(pairs, key=precedence):
        interval = _interval(own[file])
        if len(pairs[file][0]) >= 2:
            offset = _from_pairs(file, *pairs[file], interval, decisions)
        else:
            known = [(s, dated[id(s)].time) for s in streams if id(s) in dated]
            offset = _from_content(file, own[file], known, interval, decisions)
        for stream in own[file]:
            times = (part["time"] - offset.value for part in stream.records.chunks())
            dated[id(stream)] = Timed.of(stream, times, spool, offset.std, offset.rate_std)
    return [dated[id(stream)] for stream in streams]


def _some_date(streams: Sequence[Stream]) -> float | None:
    """Return some time within the records, None if no file has a date."""
    for clock in ("utc", "own"):
        for stream in streams:
            if stream.clock == clock:
                times = stream.records[:_MOST_PAIRS]["time"]
                times = times[times >= FIRST_DATE]
                if len(times):
                    return float(np.median(times))
    return None


def _dated(stream: Stream, near: float | None, decisions: Decisions) -> Iterator[Array]:
    """Yield the times of a stream, part by part."""
    times = (part["time"] for part in stream.records.chunks())
    if stream.clock == "utc" or near is None:
        if stream.clock != "utc":
            decisions.add(
                stream.label, "no file has a date: times count from midnight or the week"
            )
        yield from times
    elif stream.clock == "day":
        decisions.add(stream.label, "times of day without a date: dated by the other files")
        yield from _days(times, near)
    else:
        decisions.add(
            stream.label,
            "GPS seconds of a week that the file does not name: dated by the other files",
        )
        for time in times:
            yield gps_to_utc(np.round((near - GPS_EPOCH - time) / _WEEK), time)


def _days(times: Iterable[Array], near: float) -> Iterator[Array]:
    """Date times of day: a file may run past midnight, more than once."""
    for time in times:
        date = np.full(len(time), np.nan)
        known = np.flatnonzero(np.isfinite(time))
        if len(known):
            date[known[0]] = nearest_day(time[known[:1]], near)[0] - time[known[0]]
        out = in_order(time, date)
        if len(known):
            near = float(out[known[-1]])
        yield out


def _interval(own: Sequence[Stream]) -> float:
    pings = next((s for s in own if s.kind in ("dvl", "water")), own[0])
    steps = np.diff(pings.records[:_MOST_PAIRS]["time"])
    steps = steps[steps > 0.0]
    return float(np.median(steps)) if len(steps) else 0.0


def _pairs(
    file: str, own: Sequence[Stream], streams: Sequence[Stream], dated: Mapping[int, Timed]
) -> tuple[Array, Array]:
    """Return recording clock and UTC of the same instants."""
    received, utc = [np.empty(0)], [np.empty(0)]
    for stream in streams:
        if stream.clock != "utc" or stream.kind not in (*FIXES, "clock"):
            continue
        part, times = (x.thinned(_MOST_PAIRS) for x in (stream.records, dated[id(stream)].time))
        if stream.file == file:
            received.append(part["received"])
            utc.append(times)
        elif stream.kind == "clock":
            pings = next((s for s in own if s.kind in ("dvl", "water")), None)
            for some in () if pings is None else pings.records.chunks():
                _, a, b = np.intersect1d(some["number"], part["number"], return_indices=True)
                received.append(some["time"][a])
                utc.append(times[b])
    clock, time = np.concatenate(received), np.concatenate(utc)
    both = np.flatnonzero(np.isfinite(clock) & np.isfinite(time))
    both = both[:: max(len(both) // _MOST_PAIRS, 1)]
    return clock[both], time[both]


def _from_pairs(
    file: str, received: Array, utc: Array, interval: float, decisions: Decisions
) -> _Offset:
    difference = received - utc
    value = float(np.median(difference))
    spread = float(np.subtract(*np.percentile(difference, (95.0, 5.0)))) / 2.0
    zone = round(value / _ZONE) * _ZONE
    text = f"its clock is {value:+.2f} s from UTC (± {spread:.2f} s in {len(utc)} comparisons)"
    if value < FIRST_DATE and utc[0] - received[0] > FIRST_DATE:
        text = f"its clock starts at {_iso(-value)} UTC (± {spread:.2f} s)"
    elif zone:
        hours = (
            f"{zone / 3600.0:+g} h, local time, and {value - zone:+.2f} s, clock error and latency"
        )
        text += f", {hours}"
    decisions.add(file, f"{text} → stamps less that", "dvl.time_offset_std_s")
    duration = float(np.ptp(utc))
    rate_std = 0.0
    if duration > 0.0 and len(utc) >= 10:
        slope = float(np.polyfit(utc - utc.mean(), difference - value, 1)[0])
        if abs(slope) * duration > max(spread, 2.0 * interval):
            rate_std = 2e6 * abs(slope)
            decisions.add(
                file, f"its clock gains {slope * 1e6:.0f} ppm on UTC → a rate is estimated"
            )
    return _Offset(value, max(_LATENCY, 2.0 * spread, interval / 2.0), rate_std)


def _from_content(
    file: str,
    own: Sequence[Stream],
    known: Sequence[tuple[Stream, Stored]],
    interval: float,
    decisions: Decisions,
) -> _Offset:
    """Return the offset at which speeds or turns agree with those of streams with known times.

    Zero where stamps can be taken as they are.
    """
    stamps = np.concatenate([s.records.thinned(_MOST_PAIRS)["time"] for s in own])
    stamps = stamps[np.isfinite(stamps)]
    has_dates = len(stamps) > 0 and bool(np.median(stamps) >= FIRST_DATE)
    ground = ground_speed(known)
    if ground is None:
        decisions.add(file, "no file has UTC to compare its clock with → taken as UTC")
        return _Offset(0.0, _UNCOMPARED)
    found = None
    for what, first, second in (
        ("speeds", log_speed(own), ground),
        ("turns", turn_rate(own, [None] * len(own)), turn_rate(*zip(*known, strict=True))),
    ):
        if first is None or second is None:
            continue
        lag = lag_between(first, second, zones=has_dates)
        if lag is not None and lag.clear:
            clock = f"is {lag.lag:+.1f} s from UTC"
            if lag.lag < -FIRST_DATE:
                clock = f"starts at {_iso(-lag.lag)} UTC"
            decisions.add(
                file,
                f"its clock {clock} where its {what} agree with those of other files (correlation "
                f"{lag.peak:.2f}, next best {lag.second:.2f}) → stamps less that",
                "dvl.time_offset_std_s",
            )
            return _Offset(lag.lag, max(_LATENCY, interval))
        found = lag if found is None else found
    text = "there are no speeds or turns to compare"
    if found is not None:
        text = "no lag of speeds or turns is clear "
        text += f"(correlation {found.peak:.2f}, next best {found.second:.2f})"
    overlap = len(stamps) > 0 and stamps.min() <= ground[0][-1] and stamps.max() >= ground[0][0]
    if has_dates and overlap:
        decisions.add(
            file,
            f"its stamps overlap with those of GNSS, and {text} → taken as UTC",
            "dvl.time_offset_std_s",
        )
        return _Offset(0.0, _UNCOMPARED)
    raise DataError(
        f"its clock cannot be related to that of GNSS: stamps do not overlap, and {text}",
        where=file,
        expected="files of the same time, or a file with both clocks",
    )


def _iso(time: float) -> str:
    return str(np.datetime64(int(time * 1e3), "ms"))
