"""What has been measured so far, to be solved as a trial."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import fields, replace
from typing import Any

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.sensors.records import joined, rows_of
from factorgraph_dvl.trial import Trial


class Collected:
    """Records that grow, and lose what is too old.

    Parameters
    ----------
    known : Trial
        Trial with all but the records.
    longest : float
        S of data that are kept.
    before : float, default 1.0
        S for which rows are kept that were true before the first sample.
    heard : sequence of str, optional
        Sections of the sensors that were heard before, and whose calibration is known.
    """

    def __init__(
        self,
        known: Trial,
        longest: float,
        before: float = 1.0,
        heard: Sequence[str] = (),
    ) -> None:
        self._known = known
        self._longest = longest
        self._before = before
        self._heard = heard
        self._samples: list[Array] = []
        self._aids: dict[str, list[Aid]] = {}
        self._refused: dict[str, list[Array]] = {}

    @property
    def start(self) -> float:
        """Time of the first sample, s; infinite if there is none."""
        return float(self._samples[0][0, 0]) if self._samples else np.inf

    @property
    def empty(self) -> bool:
        """Whether there are no samples."""
        return not self._samples

    def add_samples(self, table: Array) -> None:
        """Add samples (N, 7): time, rate, force."""
        if table.shape[0]:
            self._samples.append(table)
            while self._samples[-1][-1, 0] - self._samples[0][-1, 0] > self._longest:
                self._samples.pop(0)

    def add_aid(self, record: Aid) -> None:
        """Add rows of a sensor."""
        self._aids.setdefault(record.section, []).append(record)

    def refuse(self, label: str, time: Array) -> None:
        """Note times, s, of measurements of a kind that are not believed."""
        if time.size:
            self._refused.setdefault(label, []).append(time)

    def without_refused(self, frame: LocalFrame) -> Collected | None:
        """Return the same without the rows that were refused, None if there are none."""
        if not self._refused:
            return None
        out = copy(self)
        out._refused = {}
        out._aids = {}
        for section, records in self._aids.items():
            record = joined(records)
            kinds = {o.label for o in record.observations(frame)} & self._refused.keys()
            times = [time for kind in kinds for time in self._refused[kind]]
            if times:
                record = rows_of(record, ~np.isin(record.time, np.concatenate(times)))
            if record.time.size:
                out._aids[section] = [record]
        return out

    @property
    def complete(self) -> bool:
        """Whether every sensor of the trial has been heard."""
        return all(aid.section in self._aids for aid in self._known.aids)

    def set_back(self, since: float, by: float) -> None:
        """Move the samples at and after a time by some seconds into the past."""
        table = np.concatenate(self._samples)
        table[table[:, 0] >= since, 0] -= by
        self._samples = [table]

    def give_back(self, since: float) -> list[Aid]:
        """Return rows that are true at a time or later, and let them go."""
        out = []
        for section, records in list(self._aids.items()):
            record = joined(records)
            later = record.time >= since
            if later.any():
                out.append(rows_of(record, later))
                self._aids[section] = [rows_of(record, ~later)]
        return out

    def trial(self, until: float) -> Trial:
        """Return what was collected up to a time, s."""
        samples = np.concatenate(self._samples)
        samples = samples[samples[:, 0] <= until]
        self._samples = [np.concatenate(self._samples)]
        aids: dict[str, Aid] = {}
        for section, records in self._aids.items():
            record = joined(records)
            # Rows of before are of no use, and end here.
            keep = np.flatnonzero(record.time >= self.start - self._before)
            if keep.size:
                record = rows_of(record, keep)
                self._aids[section] = [record]
                aids[section] = record
        imu = Imu(
            self._known.imu.settings,
            samples[:, 0],
            samples[:, 1:4],
            samples[:, 4:7],
            source=self._known.imu.source,
        )
        known = self._known
        if known.imu.time[0] < samples[0, 0] - 1.0:
            # What was known of the start has gone with it.
            known = replace(known, initial_attitude=None, initial_position=None)
        # Sensors that were not heard yet are not known of: their records are of the future.
        heard: dict[str, Any] = dict.fromkeys(aid.section for aid in known.aids)
        heard |= {
            aid.section: rows_of(aid, [])
            for aid in known.aids
            if aid.section in self._heard and any(p.estimated for p in aid.parameters())
        }
        heard |= aids
        named = {f.name: heard.pop(f.name) for f in fields(Trial) if f.name in heard}
        others = tuple(aid for aid in heard.values() if aid is not None)
        return replace(known, imu=imu, others=others, **named)
