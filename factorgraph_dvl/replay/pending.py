"""Pending measurements: those that arrived before the IMU has reached their time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.protocol import Aid, SensorClock
from factorgraph_dvl.sensors.records import joined, rows_of

# Times closer than this, s, are the same; chosen: the resolution of stamps in microseconds.
SAME_TIME = 1e-6
# Measurements ahead of the IMU by more than this, s, are discarded; chosen: such a lead is a wrong
# clock, not a feed that delivers out of order.
AHEAD = 60.0

# Records of a sensor from which on they are joined before they are looked at; chosen.
_MANY = 4


class PendingMeasurements:
    """Records by sensor, until the IMU reaches their time.

    Parameters
    ----------
    body_axes : BodyAxes
        Axes of the body.

    Attributes
    ----------
    rejected : Counter
        Number of measurements that were too far ahead, by label of the sensor.
    """

    def __init__(self, body_axes: BodyAxes) -> None:
        self._body_axes = body_axes
        self._records: dict[str, list[Aid]] = {}
        self._clocks: dict[str, SensorClock | None] = {}
        self.rejected: Counter[str] = Counter()

    @property
    def sections(self) -> tuple[str, ...]:
        """Sections of the sensors that have pending measurements."""
        return tuple(self._records)

    def add(self, record: Aid, newest: float = np.inf) -> None:
        """Add rows that are not too far ahead of the IMU's newest sample, s."""
        ahead = record.time > newest + AHEAD
        if ahead.any() and newest > -np.inf:
            self.rejected[record.label] += int(ahead.sum())
            if ahead.all():
                return
            record = rows_of(record, ~ahead)
        self._records.setdefault(record.section, []).append(record)

    def due(
        self,
        section: str,
        end: float,
        frame: LocalFrame | None,
        values: Mapping[str, Array],
        clock_zero: float,
    ) -> tuple[Aid, Array] | None:
        """Remove what was true before a time, and return it with its true times.

        Parameters
        ----------
        section : str
            Section of the sensor.
        end : float
            Time, s.
        frame : LocalFrame or None
            Navigation frame of the measurements; None as long as there is none.
        values : mapping of str to ndarray
            Values of the parameters, SI.
        clock_zero : float
            When the offsets of clocks hold, s.

        Returns
        -------
        tuple of (Aid, ndarray) or None
            Rows and their true times, s; None if nothing is due.
        """
        records = self._records.pop(section)
        # Many at once are fewer than one by one.
        if len(records) > _MANY:
            records = [joined(records)]

        def true_times(record: Aid) -> Array:
            clock = None if frame is None else self._clock(record, frame)
            lag = 0.0 if clock is None else clock.lag(record.time, values, clock_zero)
            return np.asarray(record.time - lag)

        taken: list[tuple[Aid, Array]] = []
        left: list[Aid] = []
        for record in records:
            true = true_times(record)
            due = true < end - SAME_TIME
            count = np.count_nonzero(due)
            if count == due.size:
                taken.append((record, true))
                continue
            if count:
                taken.append((rows_of(record, due), true[due]))
                record = rows_of(record, ~due)
            left.append(record)
        if left:
            self._records[section] = left
        if len(taken) < 2:
            return taken[0] if taken else None
        whole = joined([record for record, _ in taken])
        return whole, true_times(whole)

    def first_after(self, section: str, time: float) -> float:
        """Return the first time of a pending row after a time, s; infinite if there is none."""
        later = [r.time[r.time > time] for r in self._records.get(section, [])]
        return min((float(t.min()) for t in later if t.size), default=np.inf)

    def _clock(self, record: Aid, frame: LocalFrame) -> SensorClock | None:
        """Return the clock of a sensor, None if it is that of the IMU or not known yet."""
        section = record.section
        if section not in self._clocks:
            observations = record.observations(frame, self._body_axes)
            if not observations:
                return None
            self._clocks[section] = observations[0].clock
        return self._clocks[section]
