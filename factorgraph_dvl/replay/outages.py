"""Outages: kinds of measurements that stop arriving, and when they return."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.replay.update import Innovations

# Silence, s, that counts as an outage; chosen: several pings, and short against the time over
# which an INS drifts.
_OUTAGE = 5.0
# The same in usual intervals; chosen: an acoustic range may be missed twice in a row.
_INTERVALS = 4.0


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
