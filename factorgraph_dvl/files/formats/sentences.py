"""Sentences of NMEA 0183 form, `$ADDRESS,field,...*hh`, in any stream of bytes."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.files.formats.framing import WINDOW, Bytes, Index, Source, as_bytes
from factorgraph_dvl.files.formats.losses import UNKNOWN_TYPE, Losses

NOT_USABLE = "sentence with too few fields"
# As in the pattern below, with the address.
LONGEST = 540
_PREFIX = 80
_DATE = re.compile(
    rb"(\d{4})[-/](\d{1,2})[-/](\d{1,2})[T ,;\t](\d{1,2}):(\d{2}):(\d{2})([.,]\d{1,9})?"
)
_YEARDAY = re.compile(rb"(\d{4}):(\d{3}):(\d{2}):(\d{2}):(\d{2})(\.\d{1,9})?")
_UNIX = re.compile(rb"(?<![\d.])(1\d{9})(\d{3})?(\.\d{1,9})?(?!\d)")

_SENTENCE = re.compile(rb"\$([A-Z][A-Z0-9]{3,9}),[ -#%-)+-~]{0,512}\*[0-9A-Fa-f]{2}")


def _among(characters: bytes) -> NDArray[np.bool_]:
    """Return for each value of a byte (256,) whether it is among some."""
    return np.isin(np.arange(256), np.frombuffer(characters, np.uint8))


_DOLLAR, _STAR = b"$*"
_LINE_END = np.frombuffer(b"\0\n", np.uint8)
# What sentences begin with, what stands before their checksums, and what ends lines.
_MARK = _among(b"$*\0\n")
_LETTER = _among(b"ABCDEFGHIJKLMNOPQRSTUVWXYZ")
_NO_TEXT = _among(bytes({*range(32)} - {*b"\t\n\r"}) + b"\x7f")
_HEX = np.full(256, 256, np.int64)
_HEX[list(b"0123456789ABCDEF")] = np.arange(16)
_HEX[list(b"abcdef")] = np.arange(10, 16)


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


def text_losses(source: Source, addresses: Sequence[bytes] = ()) -> Losses:
    """Count the damage of a text file that has sentences, and sentences that no reader knows.

    Parameters
    ----------
    source : Source
        The file.
    addresses : sequence of bytes, optional
        Regular expressions of the addresses that readers know, empty where one reads none.

    Returns
    -------
    Losses
        Sentences whose checksum is wrong, such without their start or their end, and bytes that
        are no text; sentences of other addresses by their type.
    """
    losses = Losses()
    known = [re.compile(pattern) for pattern in addresses if pattern]
    others: Counter[bytes] = Counter()
    for begin in range(0, len(source), WINDOW):
        lead = min(begin, LONGEST)
        data = as_bytes(source, begin - lead, begin + WINDOW + LONGEST)
        # A checksum may be cut off.
        data = np.append(data, np.frombuffer(b"  ", np.uint8))
        here = slice(lead, lead + WINDOW)
        for what, places in (
            ("byte without text", np.flatnonzero(_NO_TEXT[data[here]]) + lead),
            *_damaged(data),
        ):
            inside = places[(places >= here.start) & (places < here.stop)]
            if len(inside):
                losses.add(what, begin - lead + int(inside[0]), len(inside))
        others.update(_addresses(source, begin))
    for address, count in others.items():
        if not any(pattern.fullmatch(address) for pattern in known):
            losses.skip(address.decode("latin-1"), UNKNOWN_TYPE, count)
    return losses


def _addresses(source: Source, begin: int) -> Iterator[bytes]:
    """Yield the addresses of the sentences that start in a window, whole ones by their look."""
    for match in _SENTENCE.finditer(source[begin : begin + WINDOW + LONGEST]):
        if match.start() >= WINDOW:
            break
        yield match[1]


def _damaged(data: Bytes) -> Iterator[tuple[str, Index]]:
    """Yield what is damaged, and where such sentences start."""
    marks = np.flatnonzero(_MARK[data])
    if not len(marks):
        return
    mark = data[marks]
    last, this = mark[:-1], mark[1:]
    # A sentence ends with its checksum, or without one with its line: not with the next one.
    starts = (last == _DOLLAR) & _LETTER[data[marks[:-1] + 1]]
    yield "sentence without its end", marks[:-1][starts & (this == _DOLLAR)]
    summed = np.flatnonzero(starts & (this == _STAR))
    start, star = marks[summed], marks[summed + 1]
    xor = np.bitwise_xor.accumulate(data)
    stated = _HEX[data[star + 1]] * 16 + _HEX[data[star + 2]]
    yield "sentence with a wrong checksum", start[(xor[star - 1] ^ xor[start]) != stated]
    # A checksum at the end of a line without `$`; other protocols have lower case before it.
    ended = np.flatnonzero((this == _STAR) & np.isin(last, _LINE_END))
    begin, star = marks[ended] + 1, marks[ended + 1]
    is_sum = (_HEX[data[star + 1]] < 16) & (_HEX[data[star + 2]] < 16)
    lower = np.concatenate([[0], np.cumsum((data >= ord("a")) & (data <= ord("z")))])
    yield "sentence without its start", begin[is_sum & (lower[star] == lower[begin])]
