"""When states are needed: once a second, or wherever an accurate attitude was measured."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.initialization.attitude_sensors import attitudes
from factorgraph_dvl.sensors.imu import ImuSettings
from factorgraph_dvl.sensors.protocol import Attitudes
from factorgraph_dvl.trial import Trial

# States this far apart, s. Measured: as good as denser ones for positions and velocities: every
# measurement hangs on the state before it through the increments up to its own time, and
# the noise of these is left out.
STATE_INTERVAL = 1.0
# Share of the variance of the attitudes between two states up to which the noise of the
# gyros may be left out. Chosen: 1 % of a standard deviation.
_SHARE = 0.02
# Least distance of states, s. Chosen: some samples of the IMU.
CLOSEST = 0.05


def dense_epochs(trial: Trial, frame: LocalFrame, interval: float) -> Array | None:
    """Return times (M,) at which states are needed besides those every `interval` s.

    The angle of the gyros walks by q t within t. Attitudes of variance sigma² each, n of
    them to a state, must not depend on that state if q interval is not far below sigma²/n.
    """
    settings = trial.inertial.settings
    seen = [s for s in attitudes(trial, frame) if needs_states(s, settings, interval)]
    time = np.unique(np.concatenate([np.empty(0), *(s.time for s in seen)]))
    return _thinned(time) if time.size else None


def needs_states(seen: Attitudes, settings: ImuSettings, interval: float) -> bool:
    """Whether attitudes need states of their own besides those every `interval` s."""
    step = float(np.median(np.diff(seen.time))) if seen.time.size > 1 else interval
    each = float(np.median(seen.sigma)) ** 2 / max(interval / step, 1.0)
    return settings.gyro_noise_root_psd**2 * interval > _SHARE * each


def _thinned(time: Array) -> Array:
    """Return times without those that follow another too closely."""
    if np.diff(time).min(initial=np.inf) >= CLOSEST:
        return time
    kept = [time[0]]
    for t in time[1:].tolist():
        if t - kept[-1] >= 0.99 * CLOSEST:
            kept.append(t)
    return np.array(kept)
