"""Three points: angles and scale from displacements between fixes (after Tang et al. 2013).

What dead reckoning by attitude and DVL makes of the way between three points, first, middle and
last, is compared with their positions,

    D_j = sum C Exp(-a) R' v_d dt / (1 + k),    j = 1, 2,

and the angles across the bow and the scale follow, again and again until nothing changes. A
vehicle moves along its bow: so the search starts with the mean velocity of the DVL along it, and
the angle about the bow stays that of the prior. Nothing but three positions is needed of GNSS;
here they and the attitude are those of SINS/GNSS. The standard deviations are those that the
positions make.

K. Tang, J. Wang, W. Li and W. Wu, A novel INS and Doppler sensors calibration method for long
range underwater vehicle navigation, Sensors 13(11), 14583-14600, 2013. At hand is its abstract: a
calibration of the scale of the DVL and of the misalignments between INS and DVL, repeated to
reduce what the alignment of the INS leaves. All else is assumed: the equation above, three points
and which, that the angle about the bow is not sought, and the standard deviations. SINS/GNSS
leaves no error of an alignment, so the repetition here is that of Gauss and Newton.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from factorgraph_dvl.baselines.navigation import NavigationMotion
from factorgraph_dvl.baselines.outcome import Estimated, Outcome, prior_of
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes, exp_so3, frd_from_body
from factorgraph_dvl.geometry.vectors import Array, rotate, skew
from factorgraph_dvl.sensors.parameters import Parameter

# Chosen: steps at most, and the one, rad or 1, below which nothing changes.
_STEPS = 20
_SETTLED = 1e-9


def three_points(
    motion: NavigationMotion,
    v_d: Array,
    misalignment: Parameter,
    scale: Parameter,
    lever_arm: Array,
    body_axes: BodyAxes,
) -> Outcome:
    """Calibrate by the positions of the first, the middle and the last ping.

    Parameters
    ----------
    motion : NavigationMotion
        Motion at M pings.
    v_d : ndarray, shape (M, 3), m/s
        Velocities of the DVL.
    misalignment, scale : Parameter
        Misalignment and scale with their priors.
    lever_arm : ndarray, shape (3,), m
        Lever arm of the DVL, taken as known.
    body_axes : BodyAxes
        Where the bow is.
    """
    R, k = exp_so3(misalignment.mean), float(scale.mean[0])
    prior = prior_of((misalignment, scale))
    if len(v_d) < 3:
        return Outcome(prior, 1)
    rows = (0, len(v_d) // 2, len(v_d) - 1)
    frame = LocalFrame(*motion.geodetic[0])
    level = frame.level_from_tangent(*motion.geodetic[:, :2].T)
    motion = replace(motion, nRb=level.transpose(0, 2, 1) @ motion.nRb)
    moved = frame.position(*motion.geodetic.T) + rotate(motion.nRb, lever_arm[None])
    truth = np.diff(moved[list(rows)], axis=0)
    # The legs have the middle point in common.
    variance = motion.covariance[list(rows), :3, :3].diagonal(axis1=1, axis2=2)
    differences = np.kron(np.diff(np.eye(3), axis=0), np.eye(3))
    of_legs = differences @ np.diag(variance.ravel()) @ differences.T
    whitening = np.linalg.inv(np.linalg.cholesky(of_legs))

    bow = frd_from_body(body_axes)[0]
    across = np.linalg.svd(bow[None])[2][1:]
    # Columns: two angles across the bow, and the scale.
    free = np.vstack([np.column_stack([across, np.zeros(2)]), np.eye(4)[3]])
    of_prior = np.linalg.inv(free @ _regular(prior.covariance) @ free.T)
    ahead = _path(motion, np.broadcast_to(bow, v_d.shape), rows)
    start = _turn(np.copysign(1.0, np.sum(truth * ahead)) * bow, v_d.mean(axis=0) @ R, across[0])
    R = R @ exp_so3(start)
    moved_by, step, count = np.append(across @ start, 0.0), np.ones(3), 0
    while np.abs(step).max() > _SETTLED and count < _STEPS:
        count += 1
        b = v_d @ R / (1.0 + k)
        # Of the velocities, and of the axes about which they turn.
        path, *turned = (_path(motion, v, rows) for v in (b, *skew(b).transpose(2, 0, 1)))
        J = np.column_stack([p.ravel() for p in turned] + [-path.ravel() / (1.0 + k)])
        J = whitening @ J @ free.T
        information = J.T @ J + of_prior
        left = whitening @ (truth - path).ravel()
        step = np.linalg.solve(information, J.T @ left - of_prior @ moved_by)
        R, k = R @ exp_so3(step[:2] @ across), k + float(step[2])
        moved_by = moved_by + step
    covariance = free.T @ np.linalg.inv(information) @ free
    kept = np.outer(bow, bow) @ prior.covariance[:3, :3] @ np.outer(bow, bow)
    covariance[:3, :3] += kept
    estimated = Estimated((misalignment, scale), (R, np.array([k])), covariance)
    return Outcome(estimated, count, converged=bool(np.abs(step).max() <= _SETTLED))


def _regular(covariance: Array) -> Array:
    """Return a covariance that can be inverted where something is known exactly."""
    return covariance + 1e-18 * np.eye(len(covariance))


def _turn(a: Array, b: Array, beside: Array) -> Array:
    """Return the shortest turn from a unit vector to a direction; half a turn is `beside`."""
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine == 0.0:
        return np.pi * beside if cosine < 0.0 else np.zeros(3)
    return np.arctan2(sine, cosine) / sine * axis


def _path(motion: NavigationMotion, velocity_b: Array, rows: tuple[int, ...]) -> Array:
    """Return the displacements that velocities in body make between rows, (2, 3), m."""
    v_n = rotate(motion.nRb, velocity_b)
    steps = 0.5 * (v_n[1:] + v_n[:-1]) * np.diff(motion.time)[:, None]
    return np.stack([steps[a:b].sum(axis=0) for a, b in pairwise(rows)])
