"""Memory that a simulated trial needs: refused before it is filled."""

from __future__ import annotations

import os
import resource
from typing import TYPE_CHECKING

from factorgraph_dvl.errors import ConfigError

if TYPE_CHECKING:
    from factorgraph_dvl.simulation.scenario import Scenario

# Measured: growth of the peak by simulating a million rows of the IMU, of GNSS, DVL or the
# reference, and by integrating a million steps of the motion.
_BYTES_PER_SAMPLE = 200
_BYTES_PER_ROW = 600
_BYTES_PER_STEP = 820


def check_size(scenario: Scenario, duration: float, steps: float) -> None:
    """Raise ConfigError if motion and records of a scenario cannot be in memory.

    Parameters
    ----------
    scenario : Scenario
        With the rates of its sensors.
    duration : float
        Of its motion, s.
    steps : float
        Of the integration of its motion.
    """
    rows = {f"{name}.rate_hz": s.rate_hz * duration for name, s in scenario.aids.items()}
    rows["reference_rate_hz"] = scenario.reference_rate_hz * duration
    needs = {key: count * _BYTES_PER_ROW for key, count in rows.items()}
    if scenario.imu is not None:
        rows["imu.rate_hz"] = scenario.imu.rate_hz * duration
        needs["imu.rate_hz"] = rows["imu.rate_hz"] * _BYTES_PER_SAMPLE
    motion = "sway" if steps > 2.0 * duration else "manoeuvres"
    rows[motion], needs[motion] = steps, steps * _BYTES_PER_STEP
    have = _memory()
    if sum(needs.values()) > have:
        key = max(needs, key=lambda k: needs[k])
        raise ConfigError(
            f"{duration:.6g} s of it are {rows[key]:.3g} steps; the trial needs about "
            f"{sum(needs.values()) / 1e9:.3g} GB of memory, and there are {have / 1e9:.3g} GB",
            where=f"{scenario.source} key {key}",
            expected="a lower rate or frequency, or shorter manoeuvres",
        )


def _memory() -> float:
    """Return the memory that a process can have, bytes."""
    installed = float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return installed if limit == resource.RLIM_INFINITY else min(installed, float(limit))
