"""Sentences of NMEA 0183 form, `$ADDRESS,field,...*hh`, in any stream of bytes."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

import numpy as np

from factorgraph_dvl.io.formats.framing import WINDOW, Source, as_bytes

# As in the pattern below, with the address.
LONGEST = 540
_PREFIX = 80
_DATE = re.compile(
    rb"(\d{4})[-/](\d{1,2})[-/](\d{1,2})[T ,;\t](\d{1,2}):(\d{2}):(\d{2})([.,]\d{1,9})?"
)
_YEARDAY = re.compile(rb"(\d{4}):(\d{3}):(\d{2}):(\d{2}):(\d{2})(\.\d{1,9})?")
_UNIX = re.compile(rb"(?<![\d.])(1\d{9})(\d{3})?(\.\d{1,9})?(?!\d)")


class Sentence(NamedTuple):
    """One sentence.

    Parameters
    ----------
    at : int
        Its position in the stream.
    address : bytes
        Talker and type, such as `GPGGA`.
    fields : list of bytes
        What follows the address, up to the checksum.
    checked : bool
        Whether it had a checksum. One whose checksum is wrong is no sentence.
    received : float
        The time that its line begins with, seconds since 1970, taken as UTC; nan where
        there is none.
    """

    at: int
    address: bytes
    fields: list[bytes]
    checked: bool
    received: float


def sentences(source: Source, addresses: bytes) -> Iterator[Sentence]:
    """Find sentences.

    Parameters
    ----------
    source : Source
        The stream; anything may stand between sentences.
    addresses : bytes
        Regular expression of the addresses wanted, without groups.

    Yields
    ------
    Sentences whose checksum is right, and such without checksum that end with their line
    or with the stream.
    """
    pattern = re.compile(rb"\$(" + addresses + rb"),([ -#%-)+-~]{0,512})(?:\*([0-9A-Fa-f]{2}))?")
    for begin in range(0, len(source), WINDOW):
        window = source[begin : begin + WINDOW + LONGEST]
        if b"$" not in window:
            continue
        xor = np.bitwise_xor.accumulate(np.frombuffer(window, np.uint8))
        is_last = begin + len(window) >= len(source)
        for match in pattern.finditer(window, 0):
            start, stop = match.start(), match.end()
            if start >= WINDOW:
                break
            if match[3] is None:
                if stop < len(window) and window[stop] not in b"\r\n\0":
                    continue
                if stop == len(window) and not is_last:
                    continue
            elif int(match[3], 16) != int(xor[stop - 4] ^ xor[start]):
                continue
            prefix = as_bytes(source, max(begin + start - _PREFIX, 0), begin + start).tobytes()
            yield Sentence(
                begin + start,
                match[1],
                match[2].split(b","),
                match[3] is not None,
                _received(prefix),
            )


def _received(prefix: bytes) -> float:
    """Return the time written before a sentence on its line, or nan."""
    prefix = prefix.rpartition(b"\n")[2]
    if len(prefix) < 10 or b"*" in prefix.rpartition(b"\\")[2]:
        return math.nan
    try:
        if match := _DATE.search(prefix):
            start = datetime(*(int(part) for part in match.groups()[:6]), tzinfo=UTC)  # type: ignore[misc,arg-type]
            return start.timestamp() + float((match[7] or b"0").replace(b",", b"."))
        if match := _YEARDAY.search(prefix):
            year, day, hour, minute, second = (int(part) for part in match.groups()[:5])
            start = datetime(year, 1, 1, hour, minute, second, tzinfo=UTC)
            return (start + timedelta(days=day - 1)).timestamp() + float(match[6] or 0)
        if match := _UNIX.search(prefix):
            return int(match[1]) + int(match[2] or 0) / 1e3 + float(match[3] or 0)
    except (ValueError, OverflowError):
        pass
    return math.nan
