"""Preintegrated measurements as GTSAM's factors take them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.vectors import IDENTITY, Array, IntArray, cross, rotate
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import Segments, integrated, nearest
from factorgraph_dvl.sensors.imu import Imu, ImuSettings

# Velocity noise that GTSAM adds to the position; only to keep its covariance regular.
_INTEGRATION_ROOT_PSD = 1e-7
# Samples from which on strides take less time than samples one by one.
_FEW = 1000


@dataclass(frozen=True)
class Preintegration:
    """Samples of an IMU, integrated between nodes, for a graph of one's own.

    Parameters
    ----------
    frame : LocalFrame
        Tangent frame n of the states.
    segments : Segments
        Increments between the K nodes.
    gravity_n : ndarray, shape (K - 1, 3)
        `LocalFrame.gravity_without_rotation` along the segments, m/s².
    measurements : list of gtsam.PreintegratedImuMeasurementsG
        One for each segment, for a `gtsam.GalileanImuFactor2` between two `NavState` and a
        `ConstantBias`.
    imu : Imu
        The IMU, of which the settings count.
    """

    frame: LocalFrame
    segments: Segments
    gravity_n: Array
    measurements: list[gtsam.PreintegratedImuMeasurementsG]
    imu: Imu

    @property
    def time(self) -> Array:
        """Times of the nodes, (K,), s."""
        return self.segments.node_time


def preintegrate(
    imu: Imu, times: ArrayLike, frame: LocalFrame, p_n: ArrayLike | None = None
) -> Preintegration:
    """Integrate the samples of an IMU between nodes, free of coning, sculling and Earth rate.

    Parameters
    ----------
    imu : Imu
        Record and noise of the IMU.
    times : array_like, shape (K,), s
        Increasing times of the nodes. Each node lies on the nearest edge between two samples;
        `Preintegration.time` has these edges.
    frame : LocalFrame
        Tangent frame n of the states.
    p_n : array_like, shape (K, 3), optional
        Positions of the nodes in n to some 10 m, m; by default all at the origin. Gravity turns
        by 16 µg in 100 m.

    Raises
    ------
    DataError
        If the IMU does not cover the times, or has a gap between them.

    Examples
    --------
    An IMU at rest for two seconds, level and in axes forward, right, down:

    >>> import numpy as np
    >>> from factorgraph_dvl import Imu, ImuSettings, LocalFrame, preintegrate
    >>> frame = LocalFrame(np.radians(36.0), np.radians(121.0), 0.0)
    >>> time = np.arange(1, 201) / 100.0
    >>> force = np.tile([0.0, 0.0, -9.8], (200, 1))
    >>> imu = Imu(ImuSettings(grade="tactical"), time, np.zeros((200, 3)), force)
    >>> chain = preintegrate(imu, [0.0, 1.0, 2.0], frame)
    >>> chain.time.round(6) + 0.0
    array([0., 1., 2.])
    >>> [round(pim.deltaTij(), 9) for pim in chain.measurements]
    [1.0, 1.0]
    """
    inc, _ = increments(imu)
    wanted = np.asarray(times, dtype=float)
    edges = np.append(inc.start, inc.end[-1])
    if wanted.ndim != 1 or wanted.size < 2 or not np.all(np.diff(wanted) > 0.0):
        raise DataError(
            "the times of the nodes do not increase", where="times", expected="two or more"
        )
    reach = float(np.median(inc.dt))
    if wanted[0] < edges[0] - reach or wanted[-1] > edges[-1] + reach:
        raise DataError(
            f"nodes from {wanted[0]:g} to {wanted[-1]:g} s, the IMU from {edges[0]:g} to "
            f"{edges[-1]:g} s",
            where="times",
            expected="times that the IMU covers",
        )
    cuts = np.unique(nearest(edges, wanted))
    if cuts.size != wanted.size:
        raise DataError(
            "two nodes lie between the same samples of the IMU",
            where="times",
            expected=f"nodes at least {reach:g} s apart",
        )
    if inc.arc_of[cuts[0]] != inc.arc_of[cuts[-1] - 1]:
        raise DataError(
            "the IMU has a gap between the first node and the last",
            where="times",
            expected="an IMU without gaps: preintegrate what is before and after it",
        )
    seg = integrated(inc, [cuts])
    places = np.zeros((cuts.size, 3)) if p_n is None else np.asarray(p_n, dtype=float)
    gravity_n = frame.gravity_without_rotation(0.5 * (places[:-1] + places[1:]))
    measurements = gtsam_measurements(seg, imu.settings, gravity_n, frame.earth_rate)
    return Preintegration(frame, seg, gravity_n, measurements, imu)


def gtsam_measurements(
    seg: Segments, settings: ImuSettings, gravity_n: Array, earth_rate_n: Array
) -> list[gtsam.PreintegratedImuMeasurementsG]:
    """Return GTSAM's preintegrated measurements of all segments.

    Each stride of the increments goes in as two constant rates and forces, or each sample as one,
    which give its rotation and velocity in GTSAM's Galilean preintegration; a stride its position
    too, and what biases do to first order. GTSAM's default kind integrates in the tangent space
    with an error of first order in the time step: 1 deg/h on a rolling, turning vessel at 1 kHz.

    Parameters
    ----------
    seg : Segments
        Increments between the nodes.
    settings : ImuSettings
        Noise of the IMU.
    gravity_n : ndarray, shape (S, 3)
        `LocalFrame.gravity_without_rotation` along the segments, m/s².
    earth_rate_n : ndarray, shape (3,), rad/s
        Earth rate in n.
    """
    inc = seg.increments
    gyro_psd = settings.gyro_noise_root_psd**2 * IDENTITY
    accel_psd = settings.accel_noise_root_psd**2 * IDENTITY
    by_sample = inc.dt.size < _FEW
    # Noise of the force moves the position within a step, too; to GTSAM it is one force there.
    length = float(inc.dt.mean()) * (1.0 if by_sample else 0.5 * seg.stride)
    within = settings.accel_noise_root_psd**2 * length**2 / 12.0
    integration_psd = (_INTEGRATION_ROOT_PSD**2 + within) * IDENTITY
    is_open = np.flatnonzero(inc.open_sigma.any(axis=1))
    some_open = is_open.searchsorted(seg.first) < is_open.searchsorted(seg.last)
    no_extra = np.zeros((3, 3))
    by_steps = _by_sample if by_sample else _by_stride
    out = []
    for block in seg.blocks():
        first, rate, force, step = by_steps(seg, block)
        forces, rates, steps = list(force), list(rate), step.tolist()
        for s, (begin, end) in enumerate(pairwise(first.tolist()), block.start):
            params = gtsam.PreintegrationParams(gravity_n[s])
            params.setOmegaCoriolis(earth_rate_n)
            params.setIntegrationCovariance(integration_psd)
            extra_gyro, extra_accel = no_extra, no_extra
            if some_open[s]:
                own = slice(seg.first[s], seg.last[s])
                extra = (inc.open_sigma[own] * inc.dt[own, None]) ** 2 / seg.duration[s]
                extra_gyro, extra_accel = (e.sum() * IDENTITY for e in np.hsplit(extra, 2))
            params.setGyroscopeCovariance(gyro_psd + extra_gyro)
            params.setAccelerometerCovariance(accel_psd + extra_accel)
            pim = gtsam.PreintegratedImuMeasurementsG(params)
            add = pim.integrateMeasurement
            for i in range(begin, end):
                add(forces[i], rates[i], steps[i])
            out.append(pim)
    return out


def _by_sample(seg: Segments, block: slice) -> tuple[IntArray, Array, Array, Array]:
    """Return steps of one sample each; see `_by_stride`."""
    first = np.concatenate([seg.first[block], seg.last[block][-1:]])
    inside = np.arange(first[0], first[-1])
    phi, dv = seg.increments.over(inside)
    step = seg.increments.dt[inside]
    dt = step[:, None]
    return first - first[0], phi / dt, _force(phi, dv, dt), step


def _by_stride(seg: Segments, block: slice) -> tuple[IntArray, Array, Array, Array]:
    """Return steps of half a stride each, which give the increments of the strides of a block.

    Over a half of h seconds that turns by psi, a constant force f gives the velocity A f and the
    position B f, with B A⁻¹ = h (I / 2 - [psi x] / 12) and no term of second order in psi, so that

        dv = u + w,    dp = B_1 A_1⁻¹ u + B_2 A_2⁻¹ w + u h

    for the velocities u and w that the halves add, in the axes at the start of the stride. The
    halves turn by phi / 2 + d and phi / 2 - d, which sweep h (phi + d).

    Returns
    -------
    first : ndarray of int, shape (S + 1,)
        First step of each segment, and the number of all.
    rate, force : ndarray, shape (T, 3)
        Constant over each step.
    duration : ndarray, shape (T,), s
        Duration of each step.
    """
    strides = seg.strides(block)
    h = 0.5 * strides.duration[:, None]
    before = strides.swept / h - 0.5 * strides.phi
    turn = exp_so3(before)
    back = turn.transpose(0, 2, 1)
    after = log_so3(back @ exp_so3(strides.phi))
    u = strides.dp / h - 0.5 * strides.dv
    u = u + (cross(before, u) + cross(rotate(turn, after), strides.dv - u)) / 12.0
    psi = np.stack([before, after], axis=1).reshape(-1, 3)
    added = np.stack([u, rotate(back, strides.dv - u)], axis=1).reshape(-1, 3)
    first = 2 * np.append(strides.begins, strides.duration.size)
    h = h.repeat(2, axis=0)
    return first, psi / h, _force(psi, added, h), h[:, 0]


def _force(phi: Array, dv: Array, dt: Array) -> Array:
    """Return the constant forces that give velocities while they turn by phi."""
    once = cross(phi, dv)
    return (dv - once / 2.0 + cross(phi, once) / 12.0) / dt
