"""The six-state filter of gyro drift as Liu, Yu and Xu (2020) print it.

States: dq, the vector part of Q_SINS Q_true⁻¹, and xi, the drift of the gyros:

    d(dq)/dt = omega_nb x dq + xi / 2,      d(xi)/dt = 0,      z = vec(Q_SINS Q_stars⁻¹).

With the identity in A (after eq. 16), xi is a drift in n, though the gyros' is in body: for a
vessel that heads elsewhere than north the drift comes out rotated. The SINS runs free from its
first attitude; nothing is fed back. Eqs. 20 and 21 cannot be used as printed (a gain without the
covariance of the innovation, and the state before the prediction): the usual ones are taken. See
`star_filter` for xi in body.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.baselines.kalman_filter import update
from factorgraph_dvl.baselines.star_filter import AttitudeTrack, StarAttitudes
from factorgraph_dvl.baselines.strapdown import StrapdownSamples, compose
from factorgraph_dvl.geometry.earth import RATE
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.vectors import Array, skew


def run_printed(
    samples: StrapdownSamples, attitudes: StarAttitudes, lat: float, drift_covariance: Array
) -> AttitudeTrack:
    """Run the printed filter over one arc, from its first attitude by the stars.

    Parameters
    ----------
    samples : StrapdownSamples
        Samples of the IMU.
    attitudes : StarAttitudes
        Attitudes within the arc.
    lat : float
        Latitude of n, rad; its rate is that of the Earth.
    drift_covariance : ndarray, shape (3, 3), rad²/s²
        Covariance of the drift in advance.
    """
    steps = compose(samples, attitudes.time[:-1], attitudes.time[1:])
    omega_in = RATE * np.array([0.0, np.cos(lat), np.sin(lat)])
    count = attitudes.time.size
    noise = 0.25 * attitudes.nRb @ attitudes.covariance @ attitudes.nRb.transpose(0, 2, 1)
    attitude, drift = np.empty((count, 3, 3)), np.empty((count, 3))
    covariance = np.empty((count, 6, 6))
    C, x, P = attitudes.nRb[0], np.zeros(6), np.zeros((6, 6))
    P[:3, :3], P[3:, 3:] = noise[0], drift_covariance
    H = np.eye(3, 6)
    for k in range(count):
        if k:
            T = steps.duration[k - 1]
            moved = exp_so3(-T * omega_in) @ C @ steps.turn[k - 1]
            F = np.eye(6)
            F[:3, :3] = exp_so3(log_so3(moved @ C.T))
            F[:3, 3:] = 0.5 * T * (np.eye(3) + 0.5 * skew(log_so3(moved @ C.T)))
            C = moved
            x, P = F @ x, F @ P @ F.T
            P[:3, :3] += 0.25 * steps.gyro_variance[k - 1] * np.eye(3)
            error = Rotation.from_matrix(C @ attitudes.nRb[k].T).as_quat()
            K, P = update(P, H, noise[k])
            x = x + K @ (error[:3] * np.sign(error[3]) - x[:3])
        attitude[k], drift[k], covariance[k] = exp_so3(-2.0 * x[:3]) @ C, x[3:], P
    return AttitudeTrack(attitudes.time, attitude, drift, covariance)
