"""Records as they arrive: twice, ahead of the IMU, by clocks that jump, or no more."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.replay.record import Innovations
from factorgraph_dvl.sensors.protocol import Aid, SensorClock
from factorgraph_dvl.sensors.records import arrays_of, joined, rows_of

# Rows of each sensor that are remembered; chosen: 8 minutes of a DVL at 10 Hz, below 1 MB.
_ROWS = 5000

_AnyAid = TypeVar("_AnyAid", bound=Aid)
# Times closer than this, s, are the same; chosen: the resolution of stamps in microseconds.
SAME_TIME = 1e-6
# Measurements ahead of the IMU by more than this, s, are discarded; chosen: such a lead is a wrong
# clock, not a feed that delivers out of order.
AHEAD = 60.0
# Records of a sensor from which on they are joined before they are looked at; chosen.
_MANY = 4
# Silence, s, that counts as an outage; chosen: several pings, and short against the time over
# which an INS drifts.
_OUTAGE = 5.0
# The same in usual intervals; chosen: an acoustic range may be missed twice in a row.
_INTERVALS = 4.0


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
        self._clocks: dict[str, tuple[SensorClock, ...]] = {}
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
            Reference time of the clock offsets, s.

        Returns
        -------
        tuple of (Aid, ndarray) or None
            Rows and their true times, s, the latest if they have several; None if nothing is due.
        """
        records = self._records.pop(section)
        # Many at once are fewer than one by one.
        if len(records) > _MANY:
            records = [joined(records)]

        def true_times(record: Aid) -> Array:
            clocks = () if frame is None else self._clocks_of(record, frame)
            lags = [clock.lag(record.time, values, clock_zero) for clock in clocks]
            return np.asarray(record.time - np.min(lags, axis=0) if lags else record.time)

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

    def _clocks_of(self, record: Aid, frame: LocalFrame) -> tuple[SensorClock, ...]:
        """Return the clocks of a sensor, none if it has that of the IMU or is not known yet."""
        section = record.section
        if section not in self._clocks:
            observations = record.observations(frame, self._body_axes)
            if not observations:
                return ()
            clocks = (o.clock for o in observations)
            self._clocks[section] = tuple(clock for clock in clocks if clock is not None)
        return self._clocks[section]


class Clocks:
    """Offsets that bring the times of all sensors onto the clock of the replay.

    Attributes
    ----------
    imu : float
        Offset added to the times of the IMU, s.
    """

    def __init__(self) -> None:
        self.imu = 0.0
        self._back = 0.0
        self._aids: dict[str, float] = {}
        self._newest: dict[str, float] = {}

    def jumped_back(self, by: float) -> None:
        """Correct for a jump of the IMU's clock back by some seconds."""
        self.imu += by
        self._back += by

    def jumped_ahead(self, by: float) -> None:
        """Correct for a jump of the IMU's clock alone, ahead by some seconds."""
        self.imu -= by

    def corrected(self, record: Aid) -> Aid:
        """Return a record on the clock of the replay.

        When the IMU's clock has jumped back, a sensor's clock has too if its own times did.
        """
        section = record.section
        clock = self._aids.get(section, 0.0)
        newest = self._newest.get(section, -np.inf)
        jump = self._back - clock
        if jump > 0.0 and float(record.time[0]) < newest - 0.5 * jump:
            clock = self._aids[section] = self._back
            newest = -np.inf
        self._newest[section] = max(newest, float(record.time[-1]))
        return replace(record, time=record.time + clock) if clock else record  # type: ignore[type-var]


class Outages:
    """Times at which each kind of measurement last arrived."""

    def __init__(self) -> None:
        # Time of arrival, and latest time of measurement.
        self._last: dict[str, tuple[float, float]] = {}
        self._interval: dict[str, float] = {}
        self._out: set[str] = set()

    def reset(self) -> None:
        """Forget arrivals, as after a gap of the IMU."""
        self._last.clear()
        self._out.clear()

    def findings(self, now: float, arrived: Sequence[Innovations]) -> list[Finding]:
        """Return which kinds have stopped by a time, s, and which are back."""
        out = []
        for i in arrived:
            time = float(i.time.max())
            before, newest = self._last.get(i.label, (now, time))
            self._last[i.label] = (now, max(time, newest))
            if now > before:
                self._interval[i.label] = min(now - before, self._interval.get(i.label, np.inf))
            if i.label in self._out:
                self._out.discard(i.label)
                text = message("heard_again.back", duration=now - before)
                out.append(Finding(Code.HEARD_AGAIN, text, i.label))
        for label, (before, newest) in self._last.items():
            longest = max(_OUTAGE, _INTERVALS * self._interval.get(label, 0.0))
            if now - before > longest and label not in self._out:
                self._out.add(label)
                out.append(
                    Finding(
                        Code.SILENT,
                        message("silent.since", time=newest),
                        label,
                    )
                )
        return out
