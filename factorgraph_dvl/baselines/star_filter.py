"""Six-state filter of gyro drift: the attitude of SINS against that of a star tracker.

States: dq, the vector part of the quaternion dQ = Q_SINS Q_true⁻¹ in the axes of n, and
xi, the drift that the SINS does not yet take off its gyros, in body:

    d(dq)/dt = -omega_in x dq + C xi / 2,      d(xi)/dt = 0,
    z = vec(Q_SINS Q_stars⁻¹) = dq + noise.

Liu, Yu and Xu (2020), eqs. 7 to 22. As printed, eq. 16 has + omega_nb x dq: the rates of
SINS and truth are subtracted as if resolved in the same axes, though the two attitudes
differ by dq; what is left of the term in n is the turn of n itself. H is printed 3 x 3, and
is [I 0]; the gain of eq. 20 needs (H P Hᵀ + R)⁻¹ in place of R⁻¹; the state on the right of
eq. 21 is the predicted one. What is estimated is fed back at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import erfa
import numpy as np
from erfa import ufunc
from scipy.spatial.transform import Rotation

from factorgraph_dvl.baselines.kalman_filter import ForwardPass, smoothed_errors, update
from factorgraph_dvl.baselines.strapdown import StrapdownSamples, compose
from factorgraph_dvl.geometry.earth import RATE, enu_from_ecef
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DAY, DEG
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.sensors.star import Star


@dataclass(frozen=True)
class StarAttitudes:
    """Attitudes by the stars at M times.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times on the clock of the IMU.
    nRb : ndarray, shape (M, 3, 3)
        Body to n, by the prior mounting.
    covariance : ndarray, shape (M, 3, 3), rad²
        Covariances of phi in nRb Exp(phi).
    """

    time: Array
    nRb: Array
    covariance: Array

    def within(self, begin: float, end: float) -> StarAttitudes:
        """Return those from `begin` to `end`, s."""
        use = (self.time >= begin) & (self.time <= end)
        return StarAttitudes(self.time[use], self.nRb[use], self.covariance[use])


@dataclass(frozen=True)
class AttitudeTrack:
    """Attitude and drift at K times of one arc.

    Parameters
    ----------
    time : ndarray, shape (K,), s
        Times on the clock of the IMU.
    nRb : ndarray, shape (K, 3, 3)
        Body to n.
    drift : ndarray, shape (K, 3), rad/s
        Drift of the gyros.
    covariance : ndarray, shape (K, 6, 6)
        Covariances of dq and xi.
    """

    time: Array
    nRb: Array
    drift: Array
    covariance: Array


def star_attitudes(star: Star, epoch: str, lat: float, lon: float) -> StarAttitudes:
    """Return the attitudes relative to east, north, up at a latitude and longitude (rad).

    C_b^n = C_e^n C_i^e C_s^i C_b^s, with C_i^e by the equinox: apparent sidereal time and
    the precession-nutation matrix.
    """
    known = np.logical_not(star.missing)
    time = star.time[known]
    iRs = Rotation.from_quat(star.quaternion[known][:, [1, 2, 3, 0]]).as_matrix()
    sRb = Rotation.from_rotvec(np.array(star.settings.mounting_deg) * DEG).as_matrix()
    eRi = _earth_from_stars(epoch, time, star.settings.ut1_utc_s)
    nRb = enu_from_ecef(lat, lon) @ eRi @ iRs @ sRb
    return StarAttitudes(time, nRb, sRb.T @ star.covariance[known] @ sRb)


def _earth_from_stars(epoch: str, time: Array, ut1_utc: float) -> Array:
    moment = datetime.fromisoformat(epoch)
    moment = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)
    unix_day, second = divmod(moment.timestamp(), DAY)
    day, fraction = 2440587.5 + unix_day, second / DAY
    # `erfa.utctai` warns of years beyond the leap seconds it knows: to catch that would change
    # the warnings of all threads.
    tai_day, tai_fraction, _ = ufunc.utctai(day, fraction)
    tt_day, tt_fraction = erfa.taitt(tai_day, tai_fraction + time / DAY)
    nutated = erfa.pnm06a(tt_day, tt_fraction)
    sidereal = erfa.gst06(day, fraction + (time + ut1_utc) / DAY, tt_day, tt_fraction, nutated)
    return np.asarray(erfa.c2teqx(nutated, sidereal, np.eye(3)))


def run_filter(
    samples: StrapdownSamples,
    attitudes: StarAttitudes,
    lat: float,
    drift: Array,
    drift_covariance: Array,
) -> ForwardPass[AttitudeTrack]:
    """Run the filter over one arc, from its first attitude by the stars.

    Parameters
    ----------
    samples : StrapdownSamples
        Samples of the IMU.
    attitudes : StarAttitudes
        Attitudes within the arc.
    lat : float
        Latitude of n, rad; its rate is that of the Earth.
    drift : ndarray, shape (3,), rad/s
        Known before.
    drift_covariance : ndarray, shape (3, 3), rad²/s²
        Covariance of the drift.
    """
    steps = compose(samples, attitudes.time[:-1], attitudes.time[1:])
    walk = samples.settings.gyro_bias_walk_root_psd**2
    omega_in = RATE * np.array([0.0, np.cos(lat), np.sin(lat)])
    count, eye = attitudes.time.size, np.eye(3)
    attitude, drifts = np.empty((count, 3, 3)), np.empty((count, 3))
    filtered, predicted = np.empty((count, 6, 6)), np.empty((count, 6, 6))
    transition, correction = np.zeros((count, 6, 6)), np.zeros((count, 6))
    noise = 0.25 * attitudes.nRb @ attitudes.covariance @ attitudes.nRb.transpose(0, 2, 1)

    C, xi = attitudes.nRb[0], drift.copy()
    P = np.zeros((6, 6))
    P[:3, :3], P[3:, 3:] = noise[0], drift_covariance
    predicted[0] = P
    F, H = np.eye(6), np.eye(3, 6)
    for k in range(count):
        if k:
            T, bias_jacobian = steps.duration[k - 1], steps.bias_jacobian[k - 1]
            turn_of_n = exp_so3(-T * omega_in)
            F[:3, :3], F[:3, 3:] = turn_of_n, 0.5 * turn_of_n @ C @ bias_jacobian
            C = turn_of_n @ C @ exp_so3(-bias_jacobian @ xi) @ steps.turn[k - 1]
            P = F @ P @ F.T
            P[:3, :3] += 0.25 * steps.gyro_variance[k - 1] * eye
            P[3:, 3:] += walk * T * eye
            transition[k], predicted[k] = F, P
            error = Rotation.from_matrix(C @ attitudes.nRb[k].T).as_quat()
            z = error[:3] * np.sign(error[3])
            K, P = update(P, H, noise[k])
            x = K @ z
            C, xi, correction[k] = exp_so3(-2.0 * x[:3]) @ C, xi + x[3:], x
        attitude[k], drifts[k], filtered[k] = C, xi, P
    track = AttitudeTrack(attitudes.time, attitude, drifts, filtered)
    return ForwardPass(track, transition, predicted, correction)


def smooth(forward: ForwardPass[AttitudeTrack]) -> AttitudeTrack:
    """Return attitude and drift given all attitudes of the arc (Rauch, Tung, Striebel)."""
    track = forward.track
    error, covariance = smoothed_errors(forward)
    nRb = exp_so3(-2.0 * error[:, :3]) @ track.nRb
    return AttitudeTrack(track.time, nRb, track.drift + error[:, 3:], covariance)


def attitude_at(
    samples: StrapdownSamples, track: AttitudeTrack, lat: float, time: Array
) -> tuple[Array, Array]:
    """Return nRb and its covariance at times (M,) within a track, by the gyros in between.

    Returns
    -------
    nRb : ndarray, shape (M, 3, 3)
        Body to n.
    covariance : ndarray, shape (M, 3, 3), rad²
        Covariances of phi in Exp(phi) nRb.
    """
    omega_in = RATE * np.array([0.0, np.cos(lat), np.sin(lat)])
    before = np.clip(np.searchsorted(track.time, time, side="right") - 1, 0, None)
    step = compose(samples, track.time[before], time)
    turned = exp_so3(-step.duration[:, None] * omega_in) @ track.nRb[before]
    free = exp_so3(-rotate(step.bias_jacobian, track.drift[before]))
    after = np.minimum(before + 1, track.time.size - 1)
    span = np.maximum(track.time[after] - track.time[before], 1e-9)
    part = ((time - track.time[before]) / span)[:, None, None]
    P = track.covariance[:, :3, :3]
    return turned @ free @ step.turn, 4.0 * (P[before] + part * (P[after] - P[before]))


def attitude_before(
    samples: StrapdownSamples, track: AttitudeTrack, lat: float, time: float
) -> Array:
    """Return nRb (3, 3) at a time before a track, in the same arc."""
    omega_in = RATE * np.array([0.0, np.cos(lat), np.sin(lat)])
    step = compose(samples, np.array([time]), track.time[:1])
    moved = exp_so3(-step.bias_jacobian[0] @ track.drift[0]) @ step.turn[0]
    return np.asarray(exp_so3(step.duration[0] * omega_in) @ track.nRb[0] @ moved.T)
