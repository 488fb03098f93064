"""Clock corrections: offsets of the sensors' clocks after jumps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_dvl.sensors.protocol import Aid


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
