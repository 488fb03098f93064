"""Velocities in sentences: Nortek `$PNORBT...`, Cerulean `$DVPDL` and `$DVEXT`.

Sources: Nortek, Signature Series manual (2017), 7.4 (`$PNORBT`), and the published fields of
`$PNORBT0`, `1`, `6`, `7`, `8`, `9` with their examples; Cerulean Sonar's documentation of the
DVL-75 and Tracker 650, outgoing messages. Axes are the maker's: signs of velocities along
beams are not verified.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats.clocks import posix
from factorgraph_dvl.files.formats.format import Batch, Format, left_out, positive
from factorgraph_dvl.files.formats.framing import BLOCK, Records, Source, map_file, number
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.formats.nmea import second_of_day
from factorgraph_dvl.files.formats.sentences import NOT_USABLE, Sentence, sentences
from factorgraph_dvl.files.formats.velocities import (
    EARTH,
    INSTRUMENT,
    attitude,
    pings,
    read_pings,
    records,
    share_of_records,
    without,
)
from factorgraph_dvl.geometry.units import DEG

Row = dict[str, object]
# Fields of the two sentences of Cerulean.
_INCREMENT, _EXTENDED = 9, 34
_NORTEK = b"PNORBT[016789]?"
_CERULEAN = b"DVPD[LX]|DVEXT"


def read_nortek(
    source: Source, block: int = BLOCK, losses: Losses | None = None
) -> Iterator[Records]:
    """Read bottom track of Nortek DVLs: formats 300, 301, 350, 351 and 356 to 359.

    Parameters
    ----------
    source : Source
        The file.
    block : int
        Number of pings at a time.
    losses : Losses, optional
        Takes counts of what was left out.

    Yields
    ------
    Records
        (N,) of `VELOCITY`; of formats that have a sentence for each beam, one record for
        the beams of one time.
    """
    losses = Losses() if losses is None else losses
    rows: list[Row] = []
    for sentence in sentences(source, _NORTEK):
        # With tags, in the same order: `NAME=value`.
        fields = [field.rpartition(b"=")[2] for field in sentence.fields]
        name = sentence.address[6:]
        row = _xyz(fields) if name in (b"6", b"7", b"8", b"9") else None
        if row is None and name in (b"", b"0", b"1"):
            row = _beam(fields, rows[-1] if rows else {})
        if row is None:
            losses.add(NOT_USABLE, sentence.at)
            continue
        if "at" not in row:
            row["at"] = sentence.at
            if len(rows) >= block:
                yield records(rows)
                rows = []
            rows.append(row)
    yield records(rows)


def _xyz(fields: list[bytes]) -> Row | None:
    if len(fields) < 11:
        return None
    values = np.array([number(field) for field in fields[:11]])
    row: Row = {
        "time": values[0],
        "velocity": without(values[3:6], -32.768),
        "merit": values[6] if values[6] < 10.0 else math.nan,
        "range": positive(values[7:11]),
    }
    if len(fields) >= 15:
        row |= {"sound_speed": number(fields[12]), "temperature": number(fields[14])}
        # The pressure of one decibar is that of a metre, to 1 %.
        row["depth"] = number(fields[13])
    return row


def _beam(fields: list[bytes], last: Row) -> Row | None:
    """Return the ping that a beam belongs to: `last`, if it has the same time."""
    if len(fields) < 9:
        return None
    beam, date = number(fields[0]), fields[1]
    if not (beam in (1.0, 2.0, 3.0, 4.0) and len(date) == 6 and date.isdigit()):
        return None
    midnight = float(posix(int(date[4:]), int(date[:2]), int(date[2:4]))[0])
    time = midnight + second_of_day(fields[2])
    row = last
    if last.get("time") != time or "beam_velocity" not in last:
        row = {"time": time, "beam_velocity": np.full(4, np.nan), "range": np.full(4, np.nan)}
    velocity, distance = number(fields[5]), number(fields[7])
    index = int(beam) - 1
    row["beam_velocity"][index] = math.nan if velocity == -32.768 else velocity  # type: ignore[index]
    row["range"][index] = distance if distance > 0.0 else math.nan  # type: ignore[index]
    return row


def read_cerulean(
    source: Source, block: int = BLOCK, losses: Losses | None = None
) -> Iterator[tuple[Records, Records]]:
    """Read Cerulean's position increments and extended data.

    Parameters
    ----------
    source : Source
        The file.
    block : int
        Number of pings at a time.
    losses : Losses, optional
        Takes counts of what was left out.

    Yields
    ------
    (N,) and (M,) of `VELOCITY`: of `$DVPDL` and `$DVPDX`, mean velocities since the ping
    before, in vehicle axes, `second` since the instrument's start; of `$DVEXT`, in Earth
    axes, `second` the sum of its elapsed times.
    """
    losses = Losses() if losses is None else losses
    increments: list[Row] = []
    extended: list[Row] = []
    elapsed = 0.0
    for sentence in sentences(source, _CERULEAN):
        if len(sentence.fields) < (_EXTENDED if sentence.address == b"DVEXT" else _INCREMENT):
            losses.add(NOT_USABLE, sentence.at)
            continue
        if sentence.address == b"DVEXT":
            elapsed = _extended(sentence, extended, elapsed)
        else:
            increments.append(_increment(sentence))
        if len(increments) + len(extended) >= block:
            yield records(increments, INSTRUMENT), records(extended, EARTH)
            increments, extended = [], []
    yield records(increments, INSTRUMENT), records(extended, EARTH)


def _increment(sentence: Sentence) -> Row:
    values = np.array([number(field) for field in sentence.fields[:_INCREMENT]])
    interval = values[1] * 1e-6
    # Without confidence the rest means nothing.
    good = values[8] > 0.0 and interval > 0.0
    velocity = values[5:8] / interval if good else np.full(3, np.nan)
    return {"at": sentence.at, "second": values[0] * 1e-6, "velocity": velocity}


def _extended(sentence: Sentence, rows: list[Row], elapsed: float) -> float:
    fields = sentence.fields
    step = number(fields[13])
    elapsed += step if 0.0 <= step < 3600.0 else 0.0
    has_lock = fields[0].strip() == b"T"
    locked = np.array([field.strip() in (b"T", b"1") for field in fields[22:26]])
    north, east, up = number(fields[9]), number(fields[10]), number(fields[7])
    beams = np.array([number(field) for field in fields[26:34]])
    rows.append(
        {
            "at": sentence.at,
            "second": elapsed,
            "velocity": np.array([east, north, up]) if has_lock else np.full(3, np.nan),
            "beam_velocity": np.where(locked, beams[:4], np.nan),
            "range": np.where(locked & (beams[4:] > 0.0), beams[4:], np.nan),
            "altitude": number(fields[8]) if has_lock else math.nan,
            "roll": number(fields[3]) * DEG,
            "pitch": number(fields[4]) * DEG,
            "heading": number(fields[5]) * DEG,
        }
    )
    return elapsed


_MEAN_INCREMENT = "velocities are means since the ping before: stamps are shifted to the middle"


def _read_cerulean(path: Path, mapping: Mapping[str, Any] | None = None) -> Iterator[Batch]:
    last = np.nan
    losses = Losses()
    for increments, extended in read_cerulean(map_file(path), losses=losses):
        if len(increments):
            batch = pings(increments, "own", "", "DVPDL")
            stamps = np.concatenate([[last], increments["second"]])
            last = float(stamps[-1])
            steps = np.diff(stamps)
            delay = np.where((steps > 0.0) & (steps < 10.0), -steps / 2.0, 0.0)
            batch.records["delay"] = delay
            batch.records["window"] = np.where(delay < 0.0, -2.0 * delay, np.nan)
            yield Batch("dvl", batch.records, "own", "DVPDL", notes=(_MEAN_INCREMENT,))
        if len(extended):
            yield pings(extended, "own", "", "DVEXT")
            yield from attitude(extended, "own")
    yield left_out(losses)


# Mean bytes of a record: what a count of records in a sample is worth.
_SENTENCE_BYTES = 120.0

FORMATS = (
    Format(
        "nortek",
        "dvl",
        "Nortek `$PNORBT0`, `1`, `6` to `9`",
        share_of_records(read_nortek, _SENTENCE_BYTES),
        partial(read_pings, read_nortek, "own", ""),
        "by its document only, with its sentences",
        in_text=True,
        addresses=_NORTEK,
    ),
    Format(
        "cerulean",
        "dvl",
        "Cerulean `$DVPDL`, `$DVEXT`",
        share_of_records(read_cerulean, _SENTENCE_BYTES),
        _read_cerulean,
        "by its document only",
        in_text=True,
        addresses=_CERULEAN,
    ),
)
