"""Duplicates: measurements that a feed delivers more than once."""

from __future__ import annotations

from collections import Counter, deque
from typing import TypeVar

import numpy as np

from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.sensors.records import arrays_of, rows_of

# Rows of each sensor that are remembered; chosen: 8 minutes of a DVL at 10 Hz, below 1 MB.
_ROWS = 5000

_AnyAid = TypeVar("_AnyAid", bound=Aid)


class Duplicates:
    """The last rows of each sensor: a row used twice would count as two measurements.

    Attributes
    ----------
    rejected : Counter
        Number of rows that had come before, by label of the sensor.
    """

    def __init__(self) -> None:
        self._order: dict[str, deque[bytes]] = {}
        self._known: dict[str, set[bytes]] = {}
        self.rejected: Counter[str] = Counter()

    def without(self, record: _AnyAid) -> _AnyAid:
        """Return a record without rows that equal an earlier one in every number."""
        order = self._order.setdefault(record.section, deque())
        known = self._known.setdefault(record.section, set())
        columns = list(arrays_of(record).values())
        new = np.ones(record.time.size, dtype=bool)
        for i in range(record.time.size):
            row = b"".join(column[i].tobytes() for column in columns)
            if row in known:
                new[i] = False
                continue
            known.add(row)
            order.append(row)
            if len(order) > _ROWS:
                known.discard(order.popleft())
        if new.all():
            return record
        self.rejected[record.label] += int((~new).sum())
        return rows_of(record, new)
