"""What has been measured so far, to be solved as a trial."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_dvl.conventions import Array
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.protocol import Aid, joined, rows_of
from factorgraph_dvl.trial import Trial


class Collected:
    """Records that grow, and lose what is too old.

    Parameters
    ----------
    known : trial with all but the records.
    longest : s of data that are kept.
    """

    def __init__(self, known: Trial, longest: float) -> None:
        self._known = known
        self._longest = longest
        self._samples: list[Array] = []
        self._aids: dict[str, list[Aid]] = {}

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

    def add_aid(self, section: str, record: Aid) -> None:
        """Add rows of a sensor."""
        self._aids.setdefault(section, []).append(record)

    def trial(self, until: float) -> Trial:
        """Return what was collected up to a time, s."""
        samples = np.concatenate(self._samples)
        samples = samples[samples[:, 0] <= until]
        self._samples = [np.concatenate(self._samples)]
        aids = {}
        for section, records in self._aids.items():
            record = joined(records)
            # Rows of before are of no use, and end here.
            keep = np.flatnonzero(record.time >= self.start - 1.0)
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
        return replace(known, imu=imu, **aids)  # type: ignore[arg-type]
