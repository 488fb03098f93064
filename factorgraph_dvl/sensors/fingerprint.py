"""Fingerprints of records, by which data that come again are recognised.

A fingerprint is the smallest hashes of a record's rows. It does not depend on names, formats
or order of files, and the rows of a part of a record are found among those of the whole.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.geometry.vectors import Array, BoolArray
from factorgraph_dvl.sensors.protocol import SensorRecord

PATTERN = r"^[a-z_]+:([0-9a-f]{16})+$"
# Hashes that a fingerprint has at most, and the share of them that makes records the same. Chosen:
# 2 kB of text; a part of a record still counts, and a short stretch in common does not.
_SIZE = 128
_SAME = 0.5
# Hashes that are sorted, of longer records. Chosen: enough where most rows come thrice.
_MANY = 4 * _SIZE
# Chosen: of records with fewer measured columns, such as depth, rows are equal by chance, and so
# many of them count as one, unless they hold the same values.
_FEWEST_COLUMNS = 3
_TOGETHER = 16
# Rows that are hashed at once. Chosen: they stay in the cache.
_CHUNK = 16384
_MIXERS = (np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9))


def fingerprints(records: Iterable[SensorRecord]) -> tuple[str, ...]:
    """Return the fingerprints of records, each with its section before it; short ones none."""
    return tuple(text for record in records if (text := _fingerprint(record)))


def shared(ours: Sequence[str], theirs: Sequence[str]) -> str:
    """Return the section of a record that two sets of fingerprints share, empty if none."""
    for one in ours:
        section, _, hashes = one.partition(":")
        for other in theirs:
            other_section, _, other_hashes = other.partition(":")
            if section == other_section and _are_same(_decode(hashes), _decode(other_hashes)):
                return section
    return ""


def _fingerprint(record: SensorRecord) -> str:
    columns = record.columns()
    names = dict.fromkeys((*record.required, *record.settings.more_columns))
    rows = [columns[name] for name in names if columns[name].dtype.kind == "f"]
    if len(rows) == 1:
        # Of beacons either measurement may be absent.
        rows = [column for column in columns.values() if column.dtype.kind == "f"]
    parts = [slice(a, a + _CHUNK) for a in range(0, max(rows[0].size, 1), _CHUNK)]
    hashes = np.concatenate([_hashes([column[part] for column in rows]) for part in parts])
    if len(rows) <= _FEWEST_COLUMNS:
        known = _known(rows)
        hashes = _joined(hashes, [column[known] for column in rows[1:]])
    smallest = _smallest(hashes).astype("<u8")
    return f"{record.section}:{smallest.tobytes().hex()}" if smallest.size else ""


def _known(rows: Sequence[Array]) -> BoolArray:
    """Whether any column but the first, the time, has a value."""
    return np.asarray(~np.all(np.isnan(rows[1:]), axis=0))


def _hashes(rows: Sequence[Array]) -> NDArray[np.uint64]:
    """Return one hash for every row that is known, by all its columns."""
    known = _known(rows)
    hashes = np.zeros(int(known.sum()), dtype=np.uint64)
    for column in rows:
        # One pattern of bits for each number: -0 is 0, and there is one nan.
        values = np.where(np.isnan(column[known]), np.nan, column[known]) + 0.0
        hashes ^= values.view(np.uint64)
        for mixer in _MIXERS:
            hashes *= mixer
            hashes ^= hashes >> np.uint64(31)
    return hashes


def _smallest(hashes: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the smallest hashes in order, each once."""
    # Few rows are equal: among so many hashes there are enough different ones, with few to sort.
    if hashes.size > _MANY:
        few = np.unique(np.partition(hashes, _MANY)[:_MANY])
        if few.size >= _SIZE:
            return few[:_SIZE]
    return np.unique(hashes)[:_SIZE]


def _joined(hashes: NDArray[np.uint64], columns: list[Array]) -> NDArray[np.uint64]:
    """Return one hash for every run of rows in which a column changes."""
    count = hashes.size - _TOGETHER + 1
    if count < 1:
        return hashes[:0]
    out = np.zeros(count, dtype=np.uint64)
    for i in range(_TOGETHER):
        out = out * _MIXERS[0] ^ hashes[i : i + count]
    changes = np.any([np.diff(np.nan_to_num(column)) != 0.0 for column in columns], axis=0)
    before = np.concatenate([[0], np.cumsum(changes)])
    return out[before[_TOGETHER - 1 :] > before[:count]]


def _decode(text: str) -> NDArray[np.uint64]:
    return np.frombuffer(bytes.fromhex(text), dtype="<u8").astype(np.uint64)


def _are_same(a: NDArray[np.uint64], b: NDArray[np.uint64]) -> bool:
    """Whether at least half of the shorter record is in the other."""
    # Of a record with more rows, those above its largest hash are not known.
    limit = min((h.max() for h in (a, b) if h.size == _SIZE), default=np.uint64(2**64 - 1))
    a, b = a[a <= limit], b[b <= limit]
    fewer = min(a.size, b.size)
    return fewer > 0 and np.intersect1d(a, b).size >= _SAME * fewer
