"""Measurements that a feed delivers more than once."""

from __future__ import annotations

from collections import deque
from typing import TypeVar

import numpy as np

from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.sensors.records import arrays_of, rows_of

# Rows of each sensor that are remembered.
_ROWS = 5000

_AnyAid = TypeVar("_AnyAid", bound=Aid)


class Repeats:
    """The last rows of each sensor, to know them again: used twice, they would count twice.

    Attributes
    ----------
    refused : number of rows that had come before, by sensor.
    """

    def __init__(self) -> None:
        self._order: dict[str, deque[bytes]] = {}
        self._known: dict[str, set[bytes]] = {}
        self.refused: dict[str, int] = {}

    def without(self, record: _AnyAid) -> _AnyAid:
        """Return the rows that have not come before; those are equal in every number."""
        order = self._order.setdefault(record.section, deque())
        known = self._known.setdefault(record.section, set())
        columns = list(arrays_of(record).values())
        new = np.ones(record.time.size, dtype=bool)
        for i in range(record.time.size):
            row = b"".join(np.ascontiguousarray(column[i]).tobytes() for column in columns)
            if row in known:
                new[i] = False
                continue
            known.add(row)
            order.append(row)
            if len(order) > _ROWS:
                known.discard(order.popleft())
        if new.all():
            return record
        self.refused[record.label] = self.refused.get(record.label, 0) + int((~new).sum())
        return rows_of(record, new)
