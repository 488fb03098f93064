"""The records so far, as a trial that a batch solver takes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import fields, replace
from typing import Any

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.sensors.records import joined, rows_of
from factorgraph_dvl.trial import Trial

# What rounding may take off a time, s: the sample at which a segment ended belongs to it.
_ROUNDING = 1e-6


class RecordHistory:
    """Records that grow.

    Parameters
    ----------
    settings : Trial
        Trial of which all but the records counts.
    """

    def __init__(self, settings: Trial) -> None:
        self._settings = settings
        self._aids: dict[str, list[Aid]] = {}
        self._rejected: dict[str, list[Array]] = {}

    @property
    def start(self) -> float:
        """Time, s, from which on all sensors have reported; infinite until they have."""
        if not self.complete:
            return np.inf
        return max(float(records[0].time[0]) for records in self._aids.values())

    @property
    def complete(self) -> bool:
        """Whether every sensor of the trial has reported."""
        return all(aid.section in self._aids for aid in self._settings.aids)

    def add_aid(self, record: Aid) -> None:
        """Add rows of a sensor."""
        self._aids.setdefault(record.section, []).append(record)

    def reject(self, label: str, time: Array) -> None:
        """Mark measurements of a kind, by their times, s, as rejected by the innovation gate."""
        if time.size:
            self._rejected.setdefault(label, []).append(time)

    def without_rejected(self, frame: LocalFrame) -> RecordHistory | None:
        """Return the history without the rejected rows, None if there are none."""
        if not self._rejected:
            return None
        out = copy(self)
        out._rejected = {}
        out._aids = {}
        for section, records in self._aids.items():
            record = joined(records)
            kinds = {
                o.label for o in record.observations(frame, self._settings.body_axes)
            } & self._rejected.keys()
            times = [time for kind in kinds for time in self._rejected[kind]]
            if times:
                record = rows_of(record, ~np.isin(record.time, np.concatenate(times)))
            if record.time.size:
                out._aids[section] = [record]
        return out

    def trial(self, until: float) -> Trial:
        """Return the records up to a time, s, as a trial."""
        for records in self._aids.values():
            records[:] = [joined(records)]
        aids = {section: record for section, (record,) in self._aids.items()}
        return _with_records(self._settings, aids).until(until)

    def newest(self, since: float, least: int) -> Trial:
        """Return the rows after a time, s, as a trial; of each sensor some at least."""
        aids = {}
        for section, records in self._aids.items():
            # Each is then larger than all after it: few are looked at, and few rows copied.
            while len(records) > 1 and records[-1].time.size >= records[-2].time.size:
                records[-2:] = [joined(records[-2:])]
            first = (int(np.searchsorted(r.time, since, side="right")) for r in records)
            parts = [rows_of(r, slice(i, None)) for r, i in zip(records, first, strict=True)]
            found = joined(parts)
            if found.time.size < least:
                found = rows_of(joined(records), slice(-least, None))
            aids[section] = found
        return _with_records(self._settings, aids)


class InertialHistory(RecordHistory):
    """Records that grow with those of an IMU, and lose what is too old.

    Parameters
    ----------
    settings : Trial
        Trial of which all but the records counts.
    longest : float
        Span of data that is kept, s.
    before : float, default 1.0
        Span before the first IMU sample from which measurements are kept, s.
    calibrated : sequence of str, optional
        Sections of sensors that have reported before, and whose calibration is known.
    """

    def __init__(
        self,
        settings: Trial,
        longest: float,
        before: float = 1.0,
        calibrated: Sequence[str] = (),
    ) -> None:
        super().__init__(settings)
        self._longest = longest
        self._before = before
        self._calibrated = calibrated
        self._samples: list[Array] = []

    @property
    def start(self) -> float:
        """Time of the first sample, s; infinite if there is none."""
        return float(self._samples[0][0, 0]) if self._samples else np.inf

    def add_samples(self, table: Array) -> None:
        """Add IMU samples (N, 7): time, angular rate, specific force."""
        if table.shape[0]:
            self._samples.append(table)
            while self._samples[-1][-1, 0] - self._samples[0][-1, 0] > self._longest:
                self._samples.pop(0)

    def shift_samples(self, since: float, by: float) -> None:
        """Move the IMU samples at and after a time by some seconds."""
        table = np.concatenate(self._samples)
        table[table[:, 0] >= since, 0] += by
        self._samples = [table]

    def remove_after(self, since: float) -> list[Aid]:
        """Remove the sensors' rows at and after a time, s, and return them."""
        out = []
        for section, records in list(self._aids.items()):
            record = joined(records)
            later = record.time >= since
            if later.any():
                out.append(rows_of(record, later))
                self._aids[section] = [rows_of(record, ~later)]
        return out

    def trial(self, until: float) -> Trial:
        """Return the records up to a time, s, as a trial."""
        whole = np.concatenate(self._samples)
        self._samples = [whole]
        samples = whole[whole[:, 0] <= until + _ROUNDING]
        aids: dict[str, Aid] = {}
        for section, records in self._aids.items():
            record = joined(records)
            # Rows from before the first sample are of no use, and end here.
            keep = np.flatnonzero(record.time >= self.start - self._before)
            if keep.size:
                record = rows_of(record, keep)
                self._aids[section] = [record]
                aids[section] = record
        settings = self._settings
        imu = replace(
            settings.inertial,
            time=samples[:, 0],
            gyro=samples[:, 1:4],
            accel=samples[:, 4:7],
            prior=settings.inertial.prior_after(samples[0, 0] - settings.inertial.time[0]),
        )
        if settings.inertial.time[0] < samples[0, 0] - 1.0:
            # What `initial` states is of a start that has been dropped.
            settings = replace(
                settings, initial_attitude=None, initial_position=None, initial_velocity=None
            )
        calibrated = {
            aid.section: rows_of(aid, [])
            for aid in settings.aids
            if aid.section in self._calibrated and any(p.estimated for p in aid.parameters())
        }
        return _with_records(settings, calibrated | aids, imu=imu)


def _with_records(settings: Trial, aids: Mapping[str, Aid], **changes: Any) -> Trial:
    """Return a trial with other records of its sensors, by section.

    A sensor that has not reported yet must not be known of: its record is of the future.
    """
    known: dict[str, Any] = {aid.section: aids.get(aid.section) for aid in settings.aids}
    named = {f.name: known.pop(f.name) for f in fields(Trial) if f.name in known}
    more = tuple(aid for aid in known.values() if aid is not None)
    return replace(settings, others=more, **named, **changes)
