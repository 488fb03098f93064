"""Dead reckoning: DVL velocity, corrected by a calibration, integrated on the ellipsoid."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import radii
from factorgraph_dvl.geometry.rotations import exp_so3, rph_from_rotation
from factorgraph_dvl.geometry.vectors import Array, interpolate, rotate
from factorgraph_dvl.imu.attitude_history import Orientation
from factorgraph_dvl.imu.timestamps import JUMP
from factorgraph_dvl.sensors import dvl as dvl_names
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.trial import Reference, Trial

OrientationAt = Callable[[Array], Orientation]

# Chosen: two lost pings are common; a longer interval counts as a gap and is bridged.
_GAP = 3.0
# Chosen: gaps are bridged with the mean velocity over a period of swell, s.
_SWELL = 10.0
# Chosen: each round divides the error by 300 or more, as the rate depends on the latitude by one
# part in 300 per radian; four reach the last digit.
_ROUNDS = 4


@dataclass(frozen=True)
class DvlMounting:
    """Mounting of a DVL: converts its velocity to that of the IMU.

    Parameters
    ----------
    dRb : ndarray, shape (3, 3)
        Misalignment, body to DVL.
    scale_error : ndarray, shape (1,) or (3,)
        Scale error, common or for each axis.
    lever_arm, bias : ndarray, shape (3,)
        Lever arm in body, m, and bias of the velocity in d, m/s.
    time_offset : float
        Delay of the DVL's times, s.
    """

    dRb: Array
    scale_error: Array
    lever_arm: Array
    bias: Array
    time_offset: float


@dataclass(frozen=True)
class DeadReckonedTrack:
    """A dead-reckoned track of the IMU.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Epochs.
    geodetic : ndarray, shape (M, 3)
        Latitude, longitude (rad), ellipsoidal height (m).
    velocity : ndarray, shape (M, 3)
        Local-level east, north, up, m/s.
    rph : ndarray, shape (M, 3)
        Roll, pitch, heading, rad.
    bridged : float
        Total time without bottom lock, s.
    """

    time: Array
    geodetic: Array
    velocity: Array
    rph: Array
    bridged: float

    @property
    def motion(self) -> Reference:
        """Positions, velocities and attitudes as a reference."""
        return Reference(self.time, self.geodetic, self.velocity, self.rph)


def mounting_of(trial: Trial, values: Mapping[str, Array] | None = None) -> DvlMounting:
    """Return the mounting that reported values state, by default that of trial.yaml.

    Parameters
    ----------
    trial : Trial
        Trial with a DVL; its settings give the parameters that `values` omit.
    values : mapping of str to ndarray, shape (n,), optional
        Values by name as in calibration.json, in reported units.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> fd.mounting_of(fd.simulate("examples/short.yaml", seed=1)).lever_arm
    array([0., 0., 0.])
    """
    given = values or {}
    si = {
        p.name: np.asarray(given[p.name], dtype=float) * p.si if p.name in given else p.mean
        for p in _log(trial).nominal().parameters()
    }
    return DvlMounting(
        dRb=exp_so3(si[dvl_names.MISALIGNMENT]),
        scale_error=np.atleast_1d(si[dvl_names.SCALE_ERROR]),
        lever_arm=si[dvl_names.LEVER_ARM],
        bias=si[dvl_names.BIAS],
        time_offset=float(np.ravel(si[dvl_names.TIME_OFFSET])[0]),
    )


def dead_reckon(
    trial: Trial,
    mounting: DvlMounting,
    orientation_at: OrientationAt,
    start: tuple[float, Array] | None = None,
) -> DeadReckonedTrack:
    """Integrate the corrected velocity of the DVL, by default from the first GNSS fix on.

        v_b = dRbᵀ ((v_d - beta) / (1 + k)) - omega_eb_b x l,    v_n = nRb v_b,
        dL/dt = v_n / (M + h),  dlon/dt = v_e / ((N + h) cos L),  dh/dt = v_u

    by the trapezoidal rule over the pings. Without lock, the velocity in body is interpolated
    between its means some seconds before and after, and rotated by the attitude. The track is
    that of the IMU; the antenna's lever arm is removed from the fix. Without GNSS the track
    starts at `initial.position`, with the velocity of the first ping.

    Parameters
    ----------
    trial : Trial
        Trial with DVL or beams, and a start.
    mounting : DvlMounting
        Mounting that corrects the velocity.
    orientation_at : OrientationAt
        Attitude and turn rate at times (M,).
    start : tuple of (float, ndarray), optional
        Time, s, and geodetic position, (3,), of the IMU to start from instead.

    Raises
    ------
    DataError
        If there is no DVL, no lock while the attitude is known, or no position to start from.

    Examples
    --------
    >>> import numpy as np
    >>> import factorgraph_dvl as fd
    >>> trial = fd.simulate("examples/short.yaml", seed=1)
    >>> solution = fd.solve(trial)
    >>> mounting = fd.mounting_of(trial, {e.name: e.value for e in solution.estimates})
    >>> history = fd.AttitudeHistory(trial.imu, solution.trajectory, trial.body_axes, np.zeros(3))
    >>> track = fd.dead_reckon(trial, mounting, history.at)
    >>> track.geodetic.shape[1]
    3
    """
    pings, v_b, _ = body_velocity(trial, mounting, orientation_at)
    if pings.size < 2:
        raise DataError(
            "fewer than two pings have a lock while the attitude is known",
            where=_log(trial).source,
            expected="bottom lock at times that IMU and attitude cover",
        )

    start_time, position = start or _start(
        trial, float(pings[0]), float(pings[-1]), orientation_at
    )
    time = _filled(pings[pings > start_time])
    time = np.concatenate([[start_time], time])
    there = orientation_at(time)
    time, nRb = time[there.covered], there.nRb[there.covered]
    knots, velocity, gaps = _with_gaps(pings, v_b)
    v_n = rotate(nRb, interpolate(time, knots, velocity))
    return DeadReckonedTrack(
        time=time,
        geodetic=integrated(time, v_n, position),
        velocity=v_n,
        rph=rph_from_rotation(nRb, trial.body_axes),
        bridged=float(np.diff(gaps[gaps[:, 0] > start_time], axis=1).sum()),
    )


def body_velocity(
    trial: Trial, mounting: DvlMounting, orientation_at: OrientationAt
) -> tuple[Array, Array, Array]:
    """Return what a DVL says of the velocity of the IMU, where lock and attitude are known.

    Parameters
    ----------
    trial : Trial
        Trial with DVL or beams.
    mounting : DvlMounting
        Mounting that corrects the velocity.
    orientation_at : OrientationAt
        Attitude and turn rate at times (M,).

    Returns
    -------
    time : ndarray, shape (M,), s
        Times of the pings, without the delay of the DVL.
    velocity : ndarray, shape (M, 3), m/s
        Velocity of the IMU in body.
    nRb : ndarray, shape (M, 3, 3)
        Attitude, body to local-level east, north, up.
    """
    dvl = _log(trial)
    pings = dvl.time[dvl.locked] - mounting.time_offset
    there = orientation_at(pings)
    used = there.covered
    unscaled = (dvl.velocity[dvl.locked][used] - mounting.bias) / (1.0 + mounting.scale_error)
    v_b = unscaled @ mounting.dRb - np.cross(there.omega_eb_b[used], mounting.lever_arm)
    return pings[used], v_b, there.nRb[used]


def _log(trial: Trial) -> Dvl:
    log = trial.log
    if log is None:
        raise DataError(
            "the trial has no DVL",
            where="trial.yaml",
            expected="a section `dvl` or `dvl_beams`",
        )
    return log


def lever_arm_error(nRb: Array, lever_arm: Array) -> Array:
    """Return the position error that a neglected lever arm causes, (M, 3), m.

    Since d(C l)/dt = C (omega x l), the integrated error is (C(t) - C(0)) l: it is bounded
    and depends on attitude alone.

    Parameters
    ----------
    nRb : ndarray, shape (M, 3, 3)
        Attitude C over time.
    lever_arm : ndarray, shape (3,), m
        Lever arm l in body.
    """
    return np.asarray((nRb - nRb[0]) @ lever_arm)


def body_positions(sensor: Gnss | Ins, orientation_at: OrientationAt) -> Reference:
    """Return the positions of the body by GNSS or an INS; attitude and velocity are zero."""
    has_fix = ~np.isnan(sensor.geodetic[:, 0])
    time, geodetic = sensor.time[has_fix], sensor.geodetic[has_fix]
    there = orientation_at(time)
    arm = np.array(sensor.settings.lever_arm_m)
    if isinstance(sensor, Gnss):
        arm = sensor.lever_arm(time[there.covered])[0]
    arm_n = rotate(there.nRb[there.covered], arm)
    moved = displaced(geodetic[there.covered], -arm_n)
    zero = np.zeros_like(moved)
    return Reference(time[there.covered], moved, zero, zero)


def displaced(geodetic: Array, enu: Array) -> Array:
    """Return geodetic coordinates (M, 3) moved by east, north, up (M, 3), m."""
    lat, _, height = geodetic.T
    meridian, east = radii(lat)
    return geodetic + np.stack(
        [
            enu[:, 1] / (meridian + height),
            enu[:, 0] / ((east + height) * np.cos(lat)),
            enu[:, 2],
        ],
        axis=1,
    )


def _start(
    trial: Trial, first: float, last: float, orientation_at: OrientationAt
) -> tuple[float, Array]:
    """Return time and position of the IMU at the first fix between the first and last ping."""
    if trial.position_sensor is not None:
        known = body_positions(trial.position_sensor, orientation_at)
        inside = np.flatnonzero((known.time >= first) & (known.time < last))
        if inside.size:
            return float(known.time[inside[0]]), known.geodetic[inside[0]]
    if trial.initial_position is not None:
        return float(trial.body_sensor.time[0]), trial.initial_position.geodetic
    raise DataError(
        "no position to start from",
        where=trial.gnss.source if trial.gnss is not None else "trial.yaml",
        expected="a position by GNSS or an INS while the DVL has a lock, or initial.position",
    )


def _with_gaps(pings: Array, v_b: Array) -> tuple[Array, Array, Array]:
    """Return knots to interpolate the velocity at, and the gaps, (G, 2), begin and end, s.

    A single ping has too much noise and swell to bridge a gap.
    """
    step = np.diff(pings)
    before = np.flatnonzero(step > _GAP * np.median(step))
    gaps = np.stack([pings[before], pings[before + 1]], axis=1)
    inside = 1e-3 * step[before]
    times, means = [pings], [v_b]
    for (begin, end), inset in zip(gaps, inside, strict=True):
        times.append(np.array([begin + inset, end - inset]))
        means += [
            v_b[(pings > begin - _SWELL) & (pings <= begin)].mean(axis=0, keepdims=True),
            v_b[(pings >= end) & (pings < end + _SWELL)].mean(axis=0, keepdims=True),
        ]
    knots = np.concatenate(times)
    order = np.argsort(knots)
    return knots[order], np.concatenate(means)[order], gaps


def _filled(pings: Array) -> Array:
    """Return the times of the pings and of the missing pings between them."""
    if pings.size < 2:
        return pings
    step = np.diff(pings)
    longest = int(np.argmax(step))
    if step[longest] > JUMP:
        raise DataError(
            f"no ping from {pings[longest]:.10g} to {pings[longest + 1]:.10g} s",
            where="DVL",
            expected="a record without jumps of the clock and without gaps of hours",
        )
    usual = float(np.median(step))
    pieces = np.maximum(np.rint(step / usual).astype(int), 1)
    begin = np.repeat(pings[:-1], pieces)
    piece = np.arange(begin.size) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    return np.append(begin + piece * np.repeat(step / pieces, pieces), pings[-1])


def integrated(time: Array, v_n: Array, start: Array) -> Array:
    """Return geodetic positions, (M, 3), from velocities (M, 3) and the first position."""
    height = start[2] + cumulative_trapezoid(v_n[:, 2], time, initial=0)
    lat = np.full(time.size, start[0])
    for _ in range(_ROUNDS):
        rate = v_n[:, 1] / (radii(lat)[0] + height)
        lat = start[0] + cumulative_trapezoid(rate, time, initial=0)
    rate = v_n[:, 0] / ((radii(lat)[1] + height) * np.cos(lat))
    lon = start[1] + cumulative_trapezoid(rate, time, initial=0)
    return np.stack([lat, lon, height], axis=1)
