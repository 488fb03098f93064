"""Attitude and turn rate at any time: a source says how the body points, the gyros fill in.

A trajectory has some epochs in a second; between them a vessel sways. So the gyros carry
the attitude from epoch to epoch, and what they miss, which grows slowly, is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.earth import RATE
from factorgraph_dvl.geometry.rotations import BodyAxes, exp_so3, log_so3, rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import Segments, segments
from factorgraph_dvl.imu.propagation import attach
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.trial import Reference

# Time between the states that the gyros are integrated from, s. Chosen: that of the graph.
_STEP = 1.0
# Time between epochs, s, beyond which the attitude is not known. Chosen: gyros alone would have
# to bridge it.
_LONGEST = 60.0


@dataclass(frozen=True)
class Orientation:
    """Attitude and turn rate at M times.

    Parameters
    ----------
    nRb : ndarray, shape (M, 3, 3)
        Body to local-level east, north, up.
    omega_eb_b : ndarray, shape (M, 3), rad/s
        Rate relative to the Earth.
    covered : ndarray, shape (M,)
        Whether both are known there.
    """

    nRb: Array
    omega_eb_b: Array
    covered: np.ndarray


class AttitudeHistory:
    """Attitude and turn rate of a body over time.

    Parameters
    ----------
    imu : Imu
        IMU whose gyros carry the attitude between the epochs.
    motion : Trajectory or Reference
        The source; its roll, pitch, heading and latitude are used.
    body_axes : BodyAxes
        Axes of the body.
    gyro_bias : ndarray, shape (3,), rad/s
        Zero if not known: through a lever arm of 1 m, 10 deg/h are 0.05 mm/s.

    Examples
    --------
    >>> import numpy as np
    >>> import factorgraph_dvl as fd
    >>> trial = fd.simulate("examples/short.yaml", seed=1)
    >>> history = fd.AttitudeHistory(trial.imu, trial.reference, trial.body_axes, np.zeros(3))
    >>> history.at(np.array([10.0])).nRb.shape
    (1, 3, 3)
    """

    def __init__(
        self, imu: Imu, motion: Trajectory | Reference, body_axes: BodyAxes, gyro_bias: Array
    ) -> None:
        self._segments = segments(increments(imu)[0], _STEP)
        self._turn = _turn_at_nodes(self._segments)
        self._gyro_bias = gyro_bias
        self._lat = float(np.mean(motion.geodetic[:, 0])) if motion.time.size else 0.0
        arc, carried, _, inside = self._carried(motion.time)
        self._time = motion.time[inside]
        self._arc = arc[inside]
        # What takes the axes that the gyros keep to local-level ones.
        nRb = rotation_from_rph(motion.rph[inside], body_axes)
        self._anchor = nRb @ carried[inside].transpose(0, 2, 1)

    def at(self, time: Array) -> Orientation:
        """Return attitude and turn rate at times (M,), s."""
        m = time.size
        if self._time.size < 2:
            return Orientation(np.tile(np.eye(3), (m, 1, 1)), np.zeros((m, 3)), np.zeros(m, bool))
        arc, carried, gyro, inside = self._carried(time)
        after = np.clip(np.searchsorted(self._time, time, side="right"), 1, self._time.size - 1)
        before = after - 1
        first, last = self._time[before], self._time[after]
        fraction = np.clip((time - first) / (last - first), 0.0, 1.0)
        drift = log_so3(self._anchor[before].transpose(0, 2, 1) @ self._anchor[after])
        nRb = self._anchor[before] @ exp_so3(fraction[:, None] * drift) @ carried
        earth_n = RATE * np.array([0.0, np.cos(self._lat), np.sin(self._lat)])
        earth_b = rotate(nRb.transpose(0, 2, 1), np.broadcast_to(earth_n, (m, 3)))
        covered = (
            inside
            & (time >= first - 1e-6)
            & (time <= last + 1e-6)
            & (last - first < _LONGEST)
            & (self._arc[before] == arc)
            & (self._arc[after] == arc)
        )
        return Orientation(nRb, gyro - self._gyro_bias - earth_b, covered)

    def _carried(self, time: Array) -> tuple[np.ndarray, Array, Array, np.ndarray]:
        """Return arc, rotation since its start and reading of the gyros; and what is covered."""
        seg = self._segments
        inc = seg.increments
        index, since, covered = inc.locate(time)
        since = np.clip(since, 0.0, inc.dt[index])
        at = attach(seg, inc.start[index] + since, np.zeros(3))
        return inc.arc_of[index], self._turn[at.node] @ at.dR, at.gyro, covered


def _turn_at_nodes(seg: Segments) -> Array:
    """Return the rotation since the start of each arc at the nodes, (K, 3, 3)."""
    turn = np.tile(np.eye(3), (seg.node_time.size, 1, 1))
    for k, dR in zip(seg.origin.tolist(), seg.totals()[0], strict=True):
        turn[k + 1] = turn[k] @ dR
    return turn
