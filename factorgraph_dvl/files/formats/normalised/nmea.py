"""NMEA sentences in common terms: fixes, courses, attitude, clocks."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats.clocks import nearest_day
from factorgraph_dvl.files.formats.format import (
    Batch,
    Clock,
    Format,
    HeadingReference,
    empty,
    left_out,
)
from factorgraph_dvl.files.formats.framing import Records, map_file
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.formats.nmea import ADDRESSES, read_nmea, utc
from factorgraph_dvl.files.formats.sentences import sentences
from factorgraph_dvl.geometry.vectors import Array

Sentences = dict[str, Records]

# GGA: 0 no fix, 6 dead reckoning, 7 typed in, 8 simulated.
_MEASURED = (1, 2, 3, 4, 5, 9)
_NO_FIX = "GGA of quality 0, 6, 7 or 8 is no measurement: left out"
_UNCHECKED = "sentence without the checksum that others in the file have"
_UNTIMED = "sentences without a time have that of the sentence with a time before them"
# Chosen: sentences with a time that wait for others of their burst; more are left of lost ones.
_WAITING = 2
_ANY = rb"[A-Z][A-Z0-9]{2,9}"


def share(path: Path, sample: bytes) -> float:
    """Return the share of a sample that is sentences, if some of them can be used."""
    if next(sentences(sample, ADDRESSES), None) is None:
        return 0.0
    return sum(
        len(s.address) + len(b",".join(s.fields)) + 7 for s in sentences(sample, _ANY)
    ) / len(sample)


def read(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    """Read a file; the parameters and the result are those of `Format.read`."""
    near: float | None = None
    checked = False
    losses = Losses()
    for block in read_nmea(map_file(path), losses=losses):
        checked = checked or any(part["checked"].any() for part in block.values())
        if checked:
            for part in block.values():
                lost = part["at"][~part["checked"]]
                losses.add(_UNCHECKED, int(lost[0]) if len(lost) else 0, len(lost))
            block = {kind: part[part["checked"]] for kind, part in block.items()}
        for batch in sentence_batches(block, near):
            if batch.clock == "utc" and len(batch.records):
                near = float(batch.records["time"][-1])
            yield batch
    yield left_out(losses)


def sentence_batches(block: Sentences, near: float | None) -> Iterator[Batch]:
    """Convert sentences.

    Parameters
    ----------
    block : dict of str to Records
        As `read_nmea` yields them.
    near : float or None, s
        Some time within half a day of sentences that have neither a date nor a time of
        reception; None if there is none.

    Yields
    ------
    Batch
    """
    times = {kind: _times(block, kind, near) for kind in ("GGA", "RMC", "ZDA", "PASHR")}
    clock: Clock = "utc"
    if not any(np.isfinite(time).any() for time in times.values()):
        clock = "day"
        times = {kind: np.array(block[kind]["second"]) for kind in times}
    yield from _fixes(block, times, clock)
    yield from _courses(block, times, clock)
    yield from _attitudes(block, times, clock)
    yield from _clocks(block, times, clock)


def _times(block: Sentences, kind: str, near: float | None) -> Array:
    time = utc(block, kind)
    part = block[kind]
    about = part["received"]
    if near is not None:
        about = np.where(np.isnan(about), near, about)
    return np.where(np.isnan(time), nearest_day(part["second"], about), time)


def _at_same_time(block: Sentences, kind: str, times: Mapping[str, Array]) -> Array:
    """Return times of sentences without one: of their burst, by arrival or by place."""
    part = block[kind]
    timed = [name for name in ("GGA", "RMC", "ZDA") if len(times[name])]
    if not timed or not len(part):
        return np.full(len(part), np.nan)
    # One sentence with a time is enough for a burst.
    timed = timed[:1]
    at = np.concatenate([block[name]["at"] for name in timed])
    time = np.concatenate([times[name] for name in timed])
    received = np.concatenate([block[name]["received"] for name in timed])
    order = np.argsort(at, kind="stable")
    last = np.searchsorted(at[order], part["at"]) - 1
    out = np.where(last >= 0, time[order[np.maximum(last, 0)]], np.nan)
    known = np.isfinite(received) & np.isfinite(time)
    stamped = np.isfinite(part["received"])
    if known.any():
        out[stamped] = _in_turn(received[known], time[known], part["received"][stamped])
    return out


def _in_turn(received: Array, time: Array, arrived: Array) -> Array:
    """Return the times that belong to arrivals, each that of the first one not yet taken.

    Arrivals are late by more than the interval of a fast receiver, in bursts; their order is
    what can be relied on.
    """
    out = np.full(len(arrived), np.nan)
    is_arrival = np.concatenate([np.zeros(len(received), int), np.ones(len(arrived), int)])
    order = np.lexsort((is_arrival, np.concatenate([received, arrived])))
    waiting: deque[float] = deque(maxlen=_WAITING)
    latest = np.nan
    for index in order.tolist():
        if index < len(received):
            latest = float(time[index])
            waiting.append(latest)
        else:
            out[index - len(received)] = waiting.popleft() if waiting else latest
    return out


def _fixes(block: Sentences, times: Mapping[str, Array], clock: Clock) -> Iterator[Batch]:
    gga, rmc, gst = block["GGA"], block["RMC"], block["GST"]
    if len(gga):
        out = empty("fix", len(gga))
        for name in ("at", "received", "lat", "lon", "height", "altitude", "quality"):
            out[name] = gga[name]
        out["time"] = times["GGA"]
        if len(gst):
            order = np.argsort(gst["second"], kind="stable")
            place = np.minimum(np.searchsorted(gst["second"][order], gga["second"]), len(gst) - 1)
            match = order[place]
            same = gst["second"][match] == gga["second"]
            std = np.stack(
                [gst[f"std_{axis}"][match] for axis in ("lon", "lat", "height")], axis=1
            )
            out["std"] = np.where(same[:, None], std, np.nan)
        measured = np.isin(out["quality"], _MEASURED) & np.isfinite(out["lat"])
        more = () if measured.all() else (_NO_FIX,)
        yield Batch("fix", out[measured], clock, "GGA", notes=more)
    valid = (rmc["valid"] > 0.0) & np.isfinite(rmc["lat"])
    if valid.any():
        out = empty("fix", len(rmc))
        for name in ("at", "received", "lat", "lon"):
            out[name] = rmc[name]
        out["time"] = times["RMC"]
        yield Batch("fix", out[valid], clock, "RMC")


def _courses(block: Sentences, times: Mapping[str, Array], clock: Clock) -> Iterator[Batch]:
    for kind in ("RMC", "VTG"):
        part = block[kind]
        out = empty("course", len(part))
        for name in ("at", "received", "speed", "course"):
            out[name] = part[name]
        if kind == "RMC":
            out["time"] = times[kind]
        else:
            out["time"] = _at_same_time(block, kind, times)
        more = () if kind == "RMC" else (_UNTIMED,)
        good = np.isfinite(out["speed"])
        if good.any():
            yield Batch("course", out[good], clock, kind, notes=more)


def _attitudes(block: Sentences, times: Mapping[str, Array], clock: Clock) -> Iterator[Batch]:
    kinds: tuple[tuple[str, tuple[str, ...], HeadingReference], ...] = (
        ("PASHR", ("roll", "pitch", "heading"), "true"),
        ("PRDID", ("roll", "pitch", "heading"), "unknown"),
        ("HDT", ("heading",), "true"),
    )
    for kind, names, reference in kinds:
        part = block[kind]
        if not len(part):
            continue
        out = empty("attitude", len(part))
        for name in ("at", "received", *names):
            out[name] = part[name]
        if kind == "PASHR":
            out["time"] = times[kind]
            for index, name in enumerate(("std_roll", "std_pitch", "std_heading")):
                out["std"][:, index] = part[name]
        else:
            out["time"] = _at_same_time(block, kind, times)
        more = () if kind == "PASHR" else (_UNTIMED,)
        yield Batch("attitude", out, clock, kind, heading=reference, notes=more)


def _clocks(block: Sentences, times: Mapping[str, Array], clock: Clock) -> Iterator[Batch]:
    padcp = block["PADCP"]
    if len(padcp):
        out = empty("clock", len(padcp))
        out["at"], out["received"] = padcp["at"], padcp["pc"]
        out["number"] = np.nan_to_num(padcp["ensemble"], nan=-1.0)
        out["time"] = padcp["pc"] - padcp["pc_minus_utc"]
        yield Batch("clock", out, "utc", "PADCP")


FORMATS = (
    Format(
        "nmea",
        "gnss",
        "NMEA 0183: GGA, RMC, VTG, ZDA, GST, HDT, `$PASHR`, `$PRDID`, `$PADCP`",
        share,
        read,
        "pynmeagps, published sentences",
        (".nmea", ".txt", ".log", ".n1r", ".n2r", ".nms"),
        in_text=True,
    ),
)
