"""The seven-state filter of Luo, Liu, Liu, Wu and Cheng (2024) as printed.

States (eq. 7): misalignment alpha (rad), scale error, lever arm (m), all constant (eqs. 8, 9).
One pass over the pings, with eqs. 10 and 12,

    z = v_d - v_b = -[v_b x] alpha + v_b k + [omega x] l,

where v_b comes from a SINS/GNSS filter that does not smooth (eq. 11). When an estimated angle
passes a threshold, the data of the DVL are rotated by it from then on, and the filter goes on
with the angle that is left and the covariance that it has.

The paper states neither threshold nor noise. See `point_set_filter` for the same model with
pings so far rotated too.
"""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.baselines.kalman_filter import update
from factorgraph_dvl.baselines.outcome import Estimated, Outcome, history_rows, prior_of
from factorgraph_dvl.baselines.point_set_filter import measurement_matrix
from factorgraph_dvl.baselines.point_sets import Points
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.parameters import Parameter

# The tuning, which the paper leaves open ("set by the noise of the DVL and the accuracy of
# SINS/GNSS together"). Chosen on its own scenario, for accuracies near its table 4:
# `reproduce luo-2024 --table 4` has what other values come to.
NOISE_FACTOR = 3000.0
THRESHOLD = 1.0 * DEG


def as_printed(
    points: Points,
    misalignment: Parameter,
    scale: Parameter,
    lever_arm: Parameter,
    *,
    factor: float = NOISE_FACTOR,
    threshold: float = THRESHOLD,
) -> Outcome:
    """Calibrate with the printed filter.

    Parameters
    ----------
    points : Points
        The two point sets, of SINS/GNSS without smoothing.
    misalignment, scale, lever_arm : Parameter
        Misalignment, scale and lever arm with their priors; one scale for the three axes.
    factor : float, default 3000
        Factor on R.
    threshold : float, default 1 deg, rad
        Angle from which on data are rotated.
    """
    parameters = (misalignment, scale, lever_arm)
    prior = prior_of(parameters)
    D, P = exp_so3(misalignment.mean), prior.covariance.copy()
    x = np.concatenate([log_so3(D.T @ prior.values[0]), *prior.values[1:]])
    keep = set(history_rows(len(points)).tolist())
    each = measurement_matrix(points.v_b, points.omega_b)
    history, rotations = [], 0
    for k in range(len(points)):
        R = (D.T * points.sigma_d[k] ** 2) @ D + points.v_b_covariance[k]
        z = D.T @ points.v_d[k] - points.v_b[k]
        K, P = update(P, each[k], factor * R)
        x = x + K @ (z - each[k] @ x)
        if np.any(np.abs(x[:3]) > threshold):
            D, rotations = D @ exp_so3(x[:3]), rotations + 1
            x = np.concatenate([np.zeros(3), x[3:]])
        if k in keep:
            history.append((float(points.time[k]), _estimated(parameters, D, x, P)))
    rotated = Finding(
        Code.METHOD_LIMITS, message("method_limits.luo_rotated", rotations=rotations)
    )
    tuning = message("method_limits.luo_tuning", factor=factor, threshold=threshold / DEG)
    findings = (Finding(Code.METHOD_LIMITS, tuning), rotated)
    return Outcome(_estimated(parameters, D, x, P), 1, tuple(history), findings=findings)


def _estimated(parameters: tuple[Parameter, ...], D: Array, x: Array, P: Array) -> Estimated:
    return Estimated(parameters, (D @ exp_so3(x[:3]), x[3:4], x[4:]), P)
