"""The clocks of the sensors against the one on which the replay runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_dvl.sensors.protocol import Aid


class Clocks:
    """What is added to the times of each sensor.

    Attributes
    ----------
    imu : of the IMU, s.
    """

    def __init__(self) -> None:
        self.imu = 0.0
        self._back = 0.0
        self._aids: dict[str, float] = {}
        self._newest: dict[str, float] = {}

    def jumped_back(self, by: float) -> None:
        """Note that the clock of the IMU jumped back by some seconds."""
        self.imu += by
        self._back += by

    def jumped_ahead(self, by: float) -> None:
        """Note that the clock of the IMU alone jumped ahead by some seconds."""
        self.imu -= by

    def on_time(self, record: Aid) -> Aid:
        """Return a record on the clock of the replay.

        When the IMU's clock has jumped back, a sensor's has too if its own times did.
        """
        section = record.section
        clock = self._aids.get(section, 0.0)
        newest = self._newest.get(section, -np.inf)
        jump = self._back - clock
        if jump > 0.0 and float(record.time[0]) < newest - 0.5 * jump:
            clock = self._aids[section] = self._back
            newest = -np.inf
        self._newest[section] = max(newest, float(record.time[-1]))
        if clock:
            record = replace(record, time=record.time + clock)  # type: ignore[type-var]
        return record
