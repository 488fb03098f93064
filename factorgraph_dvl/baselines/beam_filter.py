"""Extended Kalman filter of single beams against the velocity of SINS/GNSS.

States: attitude error phi of SINS/GNSS (level axes, true nRb = Exp(phi) nRb), turns eta of
the beams from their nominal directions, scale errors k, lever arm l; all constant but phi,
a first-order Gauss-Markov process. Each beam that was
received at a ping gives

    z_i = (1 + k_i) d_i(eta_i)^T (v_b + omega_b x l),    v_b = nRb^T (v_n + [v_n x] phi).

Attitude errors as states and all four beams in one filter as in the patent of Cao, Sun,
Liu, Zhang and Liu (Harbin Engineering University). As printed, the measurements are velocities
from groups g of three beams in the computed axes n' (claims 4 to 6),

    v_g = nRb (A_g^-1 z_g - omega x l),    v_n = v_g + phi x v_g,

with A_g the rows (1 + k_i) d_i^T, and phi turns with n. Their errors count as independent,
although four groups of four beams share them. Single beams need no groups, and go on with two or
one. The copy of the patent breaks off within claim 6: what follows it is derived here.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from factorgraph_dvl.baselines.kalman_filter import update
from factorgraph_dvl.baselines.navigation import NavigationMotion
from factorgraph_dvl.baselines.outcome import Estimated, Outcome, history_rows, prior_of
from factorgraph_dvl.baselines.spurious_information import widened
from factorgraph_dvl.geometry.earth import RATE
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.unit_vectors import turned, turned_jacobian
from factorgraph_dvl.geometry.vectors import Array, rotate, skew
from factorgraph_dvl.sensors.parameters import Parameter

# Chosen: correlation time of the smoothed errors of the attitude, s.
_CORRELATION_TIME = 300.0
# Chosen: passes over the data at most.
_PASSES = 6
# Chosen: change from pass to pass, in standard deviations, at which the filter has converged.
_CONVERGED = 0.05


@dataclass(frozen=True)
class BeamPings:
    """Radial velocities with the motion of the body at M pings.

    Parameters
    ----------
    motion : NavigationMotion
        Smoothed, at the pings.
    nominal_b : ndarray, shape (N, 3)
        Nominal directions of the beams in body.
    measured, sigma : ndarray, shape (M, N)
        Radial velocities and their standard deviations, m/s; nan where a beam was lost.
    """

    motion: NavigationMotion
    nominal_b: Array
    measured: Array
    sigma: Array


@dataclass(frozen=True)
class _Linear:
    """Measurements linearised about a calibration: z = predicted + H (x - x0)."""

    predicted: Array
    by_state: Array
    variance: Array


def beam_filter(
    pings: BeamPings, parameters: tuple[Parameter, ...], *, printed: bool = False
) -> Outcome:
    """Calibrate single beams.

    The filter runs again over the data, linearised about what it found, until that no
    longer changes; the first pass is the history.

    Parameters
    ----------
    pings : BeamPings
        Radial velocities and motion.
    parameters : tuple of Parameter
        Directions, scale errors and lever arm, with their priors.
    printed : bool, default False
        Compare velocities of groups of three beams, with an attitude error that nothing drives.
    """
    prior = prior_of(parameters)
    at = np.concatenate(prior.values)
    history: tuple[tuple[float, Estimated], ...] = ()
    keep = set(history_rows(len(pings.measured)).tolist())
    converged = False
    for count in range(1, _PASSES + 1):
        states = _filter(pings, prior, at, keep if count == 1 else set(), printed=printed)
        if count == 1:
            history = tuple(
                (float(pings.motion.time[i]), _estimated(parameters, x[3:], P[3:, 3:]))
                for i, x, P in states[:-1]
            )
        x, P = states[-1][1][3:], states[-1][2][3:, 3:]
        moved = np.abs(x - at) / np.sqrt(np.maximum(np.diag(P), 1e-30))
        at = x
        converged = float(moved[np.diag(P) > 0.0].max(initial=0.0)) <= _CONVERGED
        if converged:
            break
    return Outcome(_estimated(parameters, at, P), count, history, converged=converged)


def attitude_errors(
    pings: BeamPings, estimated: Estimated, *, printed: bool = False
) -> tuple[Array, Array, Array]:
    """Return what the filter finds of the attitude errors, linearised about a calibration.

    Returns
    -------
    time : ndarray, shape (H,), s
        Times of the pings of a history.
    phi : ndarray, shape (H, 3), rad
        Error in true nRb = Exp(phi) nRb.
    covariance : ndarray, shape (H, 3, 3), rad²
        Covariances of phi.
    """
    rows = history_rows(len(pings.measured))
    prior = prior_of(estimated.parameters)
    at, keep = np.concatenate(estimated.values), set(rows.tolist())
    states = _filter(pings, prior, at, keep, printed=printed)[:-1]
    phi = np.array([x[:3] for _, x, _ in states]).reshape(-1, 3)
    covariance = np.array([P[:3, :3] for _, _, P in states]).reshape(-1, 3, 3)
    return pings.motion.time[rows], phi, covariance


def beam_residuals(pings: BeamPings, estimated: Estimated) -> tuple[Array, Array]:
    """Return predicted - measured and its standard deviation, (M, N), m/s."""
    linear = _linearised(pings, np.concatenate(estimated.values))
    attitude = np.einsum(
        "mni,mij,mnj->mn",
        linear.by_state[:, :, :3],
        pings.motion.covariance[:, 6:9, 6:9],
        linear.by_state[:, :, :3],
    )
    return linear.predicted - pings.measured, np.sqrt(linear.variance + attitude)


def without_spurious_information(pings: BeamPings, estimated: Estimated) -> Estimated:
    """Return the estimate, wider where its information on directions and scales is spurious."""
    if not len(pings.measured):
        return estimated
    at = np.concatenate(estimated.values)
    linear = _linearised(pings, at)
    n = pings.measured.shape[1]
    weight = np.where(np.isnan(pings.measured), 0.0, 1.0 / linear.variance)
    H = linear.by_state[:, :, 3:]
    information = np.einsum("mni,mn,mnj->ij", H, np.nan_to_num(weight), H, optimize=True)
    noise = np.zeros_like(information)
    turns, scale, _ = np.split(at, [2 * n, 3 * n])
    turns = turns.reshape(n, 2)
    by_turn = (1.0 + scale)[:, None, None] * turned_jacobian(pings.nominal_b, turns)
    directions = turned(pings.nominal_b, turns)
    for i in range(n):
        own = [2 * i, 2 * i + 1, 2 * n + i]
        J = np.column_stack([by_turn[i], directions[i]])
        spread = np.einsum("m,mij->ij", np.nan_to_num(weight[:, i]), pings.motion.v_b_covariance)
        noise[np.ix_(own, own)] = J.T @ spread @ J
    return widened(estimated, information, noise)


def _estimated(parameters: tuple[Parameter, ...], x: Array, P: Array) -> Estimated:
    ends = np.cumsum([p.mean.size for p in parameters])[:-1]
    return Estimated(parameters, tuple(np.split(x, ends)), P)


def _filter(
    pings: BeamPings, prior: Estimated, at: Array, keep: set[int], *, printed: bool
) -> list[tuple[int, Array, Array]]:
    """Return states and covariance after the pings to keep, and at the end."""
    linear, measured = (
        _by_groups(pings, at) if printed else (_linearised(pings, at), pings.measured)
    )
    wander = pings.motion.covariance[:, 6:9, 6:9]
    n = at.size
    x = np.concatenate([np.zeros(3), np.concatenate(prior.values)])
    P = np.zeros((n + 3, n + 3))
    P[3:, 3:] = prior.covariance
    origin = np.concatenate([np.zeros(3), at])
    time = pings.motion.time
    lat = pings.motion.geodetic[1:, 0]
    earth = RATE * np.column_stack([np.zeros_like(lat), np.cos(lat), np.sin(lat)])
    turn_of_n = exp_so3(-np.diff(time)[:, None] * earth)
    out = []
    if time.size:
        P[:3, :3] = wander[0]
    for k in range(time.size):
        if k:
            # The noise of the process keeps the variance of phi.
            fade = 1.0 if printed else np.exp(-(time[k] - time[k - 1]) / _CORRELATION_TIME)
            F = turn_of_n[k - 1] if printed else fade * np.eye(3)
            x[:3] = F @ x[:3]
            P[:3] = F @ P[:3]
            P[:, :3] = P[:, :3] @ F.T
            P[:3, :3] += (1.0 - fade**2) * wander[k]
        valid = ~np.isnan(measured[k])
        H = linear.by_state[k, valid]
        innovation = measured[k, valid] - linear.predicted[k, valid] - H @ (x - origin)
        K, P = update(P, H, linear.variance[k, valid])
        x = x + K @ innovation
        if k in keep:
            out.append((k, x.copy(), P.copy()))
    out.append((time.size, x, P))
    return out


def _linearised(pings: BeamPings, at: Array) -> _Linear:
    """Return predictions at a calibration, with phi = 0, and their derivatives.

    Errors of the SINS/GNSS velocity count as if they were new at every ping.
    """
    motion = pings.motion
    m, n = pings.measured.shape
    turns, scale, arm = np.split(at, [2 * n, 3 * n])
    turns = turns.reshape(n, 2)
    directions = turned(pings.nominal_b, turns)
    by_turn = turned_jacobian(pings.nominal_b, turns)
    rows = (1.0 + scale)[:, None] * directions
    bRn = motion.nRb.transpose(0, 2, 1)
    at_dvl = motion.v_b + np.cross(motion.omega_b, arm)
    by_state = np.zeros((m, n, 3 + at.size))
    by_state[:, :, :3] = rows @ (bRn @ skew(motion.velocity))
    each = np.arange(n)
    for axis in range(2):
        along = at_dvl @ ((1.0 + scale)[:, None] * by_turn[:, :, axis]).T
        by_state[:, each, 3 + 2 * each + axis] = along
    by_state[:, each, 3 + 2 * n + each] = at_dvl @ directions.T
    by_state[:, :, 3 + 3 * n :] = rows @ skew(motion.omega_b)
    velocity = bRn @ motion.covariance[:, 3:6, 3:6] @ motion.nRb
    square = arm**2
    shaken = 0.5 * (motion.omega_sigma**2 @ (square.sum() - square))
    variance = np.einsum("ni,mij,nj->mn", rows, velocity, rows)
    return _Linear(at_dvl @ rows.T, by_state, variance + pings.sigma**2 + shaken[:, None])


def _by_groups(pings: BeamPings, at: Array) -> tuple[_Linear, Array]:
    """Return the velocities of M pings by G groups, linearised, and what they are compared with.

    The latter is the velocity of the reference, (M, 3G), once for each group.
    """
    motion, n = pings.motion, pings.measured.shape[1]
    turns, scale, arm = np.split(at, [2 * n, 3 * n])
    turns = turns.reshape(n, 2)
    directions, by_turn = turned(pings.nominal_b, turns), turned_jacobian(pings.nominal_b, turns)
    found = tuple(combinations(range(n), 3))
    shape = (len(motion.time), len(found), 3)
    predicted, variance = np.zeros(shape), np.zeros(shape)
    by_state = np.zeros((*shape, 3 + at.size))
    of_reference = np.diagonal(motion.covariance[:, 3:6, 3:6], axis1=1, axis2=2)
    for g, group in enumerate(found):
        beams = list(group)
        gain = (1.0 + scale[beams])[:, None] * directions[beams]
        inverse = np.linalg.inv(gain)
        at_dvl = pings.measured[:, beams] @ inverse.T
        T = motion.nRb @ inverse
        predicted[:, g] = rotate(motion.nRb, at_dvl - np.cross(motion.omega_b, arm))
        by_state[:, g, :, :3] = -skew(predicted[:, g])
        for column, i in enumerate(beams):
            for axis in range(2):
                along = (1.0 + scale[i]) * at_dvl @ by_turn[i, :, axis]
                by_state[:, g, :, 3 + 2 * i + axis] = -T[:, :, column] * along[:, None]
            along = at_dvl @ directions[i]
            by_state[:, g, :, 3 + 2 * n + i] = -T[:, :, column] * along[:, None]
        by_state[:, g, :, 3 + 3 * n :] = -motion.nRb @ skew(motion.omega_b)
        variance[:, g] = rotate(T**2, pings.sigma[:, beams] ** 2) + of_reference
    rows = (shape[0], shape[1] * 3)
    measured = np.where(
        np.isnan(predicted), np.nan, np.repeat(motion.velocity[:, None], shape[1], axis=1)
    )
    linear = _Linear(predicted.reshape(rows), by_state.reshape(*rows, -1), variance.reshape(rows))
    return linear, measured.reshape(rows)
