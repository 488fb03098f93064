"""Start of a single-beacon filter: the two mirror images that three ranges leave.

On a straight run at constant speed w over ground the squared horizontal distance to the beacon
is a parabola in time, d² = c² + (a + w t)². Three of them give w, the distance a along the run
and |c| across it, but not the side. Chen, Shang and Lan (2021) follow both by a filter each and
drop one after a turn; their equation is lost in the copies that we have.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.baselines.single_beacon import Filtered, Method, run_filter
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.sensors.depth import Depth
from factorgraph_dvl.sensors.speed_log import Heading
from factorgraph_dvl.trial import Trial

# Chosen: standard deviation of a start, relative to its distance: the course over ground is not
# known better than the heading, and a current of 0.3 m/s turns that of 2 m/s by 0.15 rad.
_RELATIVE_STD = 0.15


@dataclass(frozen=True)
class Tracks:
    """The filters from both mirror images, the one that the data prefer first.

    Parameters
    ----------
    filtered : tuple of (Filtered, Filtered)
        What each filter found.
    misfit : ndarray, shape (2,)
        Mean square of the normalised innovations of each.
    """

    filtered: tuple[Filtered, Filtered]
    misfit: Array


def mirror_pair(trial: Trial, times: tuple[float, float, float]) -> tuple[Array, Array]:
    """Return both positions at the first time, (2, 2), m, in the trial's frame, and the deviation.

    Parameters
    ----------
    trial : Trial
        Trial with one beacon, on a straight run over the times.
    times : tuple of (float, float, float)
        When the ranges are taken, s.

    Raises
    ------
    DataError
        If the three ranges belong to no straight run.
    """
    beacons, depth = trial.required(Beacons), trial.required(Depth)
    compass, frame = trial.required(Heading), trial.frame()
    known = np.flatnonzero(~np.isnan(beacons.range))
    rows = known[np.searchsorted(beacons.time[known], np.array(times) - 1e-6)]
    place = frame.position(*next(iter(beacons.settings.positions.values())).geodetic)
    below = np.interp(beacons.time[rows], depth.time, depth.depth)
    above = depth.settings.sea_surface_height_m - below - frame.height - place[2]
    square = beacons.range[rows] ** 2 - above**2
    t = beacons.time[rows] - beacons.time[rows[0]]
    by_square, by_time, start = np.polyfit(t, square, 2)
    if by_square <= 0.0 or start <= 0.0:
        raise DataError(
            "the three ranges do not fit a straight run at constant speed",
            where=beacons.source,
            expected="ranges whose square is a parabola in time, opening upwards",
        )
    along = by_time / (2.0 * np.sqrt(by_square))
    across = np.sqrt(max(start - along**2, 0.0))
    heading = float(np.interp(beacons.time[rows[0]], compass.time, compass.heading))
    ahead = np.array([np.sin(heading), np.cos(heading)])
    starboard = np.array([ahead[1], -ahead[0]])
    pair = place[:2] + along * ahead + np.outer([1.0, -1.0], across * starboard)
    return pair, np.full(2, _RELATIVE_STD * np.sqrt(start))


def both_tracks(trial: Trial, method: Method, times: tuple[float, float, float]) -> Tracks:
    """Follow both mirror images, and say which the data prefer.

    The paper drops the track whose covariance grows. That of an extended Kalman filter does not
    depend on the innovations, so these decide here.
    """
    pair, std = mirror_pair(trial, times)
    found = [run_filter(trial, method, mean, std) for mean in pair]
    misfit = np.array(
        [
            np.mean(np.concatenate([((r.residual / r.sigma) ** 2).ravel() for r in f.innovations]))
            for f in found
        ]
    )
    first, second = np.argsort(misfit).tolist()
    return Tracks((found[first], found[second]), misfit[[first, second]])
