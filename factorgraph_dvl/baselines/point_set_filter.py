"""Seven-state filter between two point sets, which settles at any misalignment.

States: misalignment alpha (rad), scale error, lever arm (m), all constant. From
v_d = (1 + k)(I + [alpha x])(v_b + omega x l), to first order in all of them,

    z = v_d - v_b = -[v_b x] alpha + v_b k + [omega x] l.

The model is that of Luo, Liu, Liu, Wu and Cheng (2024); their filter is in `luo_2024`. It rotates
the data by an estimated angle from then on, so that the pings before keep what the large angle
did to them. Here all pings are rotated, those so far too. As the states are constant, sums over
the pings are enough for that:

    A = sum H' R^-1 H,    b(D) = sum H' R^-1 (D' v_d - v_b),

where b is linear in the rotation D that is taken off the data. After each ping a Newton step is
made towards the D for which no angle is left. Its Jacobian is the derivative of b with respect to
D, not A: the model neglects alpha x (omega x l), and with A the iteration diverges where omega x l
is as large as the velocity across the bow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.baselines.outcome import Estimated, Outcome, history_rows, prior_of
from factorgraph_dvl.baselines.point_sets import Points, misfit, rotation_starts
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, cross_variance, skew
from factorgraph_dvl.sensors.parameters import Parameter

# Chosen: scale error, halfway between 0 and that of the mirror image, and mean square of the
# normalised residuals at which the filter starts once more.
_MIRRORED = -0.5
_POOR_FIT = 9.0
# Chosen: steps at the end at most, and the one, in standard deviations, below which the filter
# has settled. Measured on the scenario of Luo et al.: 1e-7 after three.
_STEPS = 20
_SETTLED = 1e-3
# Chosen: largest turn of a step, rad; the first pings, at rest, ask for any.
_LONGEST = 1.0
# Chosen: prior standard deviation beyond which a misalignment may be anything.
_WIDE = 30.0 * DEG


def point_set(
    points: Points, misalignment: Parameter, scale: Parameter, lever_arm: Parameter
) -> Outcome:
    """Calibrate with the seven-state filter.

    From more than 90 degrees off the small-angle model ends in the mirror image, turned
    by 180 degrees with a scale error near -2, or where no rotation fits. The filter then starts
    once more near the end that fits best of those that the 24 rotations of a cube lead to.

    Parameters
    ----------
    points : Points
        The two point sets.
    misalignment, scale, lever_arm : Parameter
        Misalignment, scale and lever arm with their priors; one scale for the three axes.
    """
    prior = prior_of((misalignment, scale, lever_arm))
    starts = rotation_starts(misalignment)
    sums, history = _filter(points, prior, starts[0])
    best, settled = _settle(sums, prior, history[-1][1].values[0] if history else starts[0])
    mirrored = best.values[1][0] < _MIRRORED
    if len(starts) > 1 and (mirrored or misfit(points, best, lever_arm.mean) > _POOR_FIT):
        few = points.thinned()
        ends = [_settle(sums, prior, start)[0] for start in starts]
        fits = [
            misfit(few, e, lever_arm.mean) if e.values[1][0] > _MIRRORED else np.inf for e in ends
        ]
        near = _near(prior, ends[int(np.argmin(fits))].values[0])
        sums, again = _filter(points, near, near.values[0])
        other, also = _settle(sums, prior, again[-1][1].values[0])
        if mirrored or misfit(points, other, lever_arm.mean) < misfit(
            points, best, lever_arm.mean
        ):
            best, settled, history = other, also, again
    return Outcome(best, 1, history, converged=settled)


def measurement_matrix(v_b: Array, omega_b: Array) -> Array:
    """Return H = [-[v_b x], v_b, [omega x]] of pings, (M, 3, 7).

    Parameters
    ----------
    v_b : ndarray, shape (M, 3)
        Velocity over the Earth, in body, m/s.
    omega_b : ndarray, shape (M, 3), rad/s
        Rate relative to the Earth.
    """
    return np.concatenate([-skew(v_b), v_b[:, :, None], skew(omega_b)], axis=2)


@dataclass(frozen=True)
class _Sums:
    """Sums over pings, of which b(D) = by_rotation : D - by_body for any rotation D.

    Parameters
    ----------
    information : ndarray, shape (7, 7)
        A.
    by_rotation : ndarray, shape (7, 3, 3)
        Product of H' R^-1 and v_d, by the rows and columns of D.
    by_body : ndarray, shape (7,)
        Product of H' R^-1 v_b.
    """

    information: Array
    by_rotation: Array
    by_body: Array

    def and_(self, points: Points, D: Array, lever_arm: Array) -> _Sums:
        """Return the sums with more pings, weighted as rotation and lever arm have them."""
        H = measurement_matrix(points.v_b, points.omega_b)
        R = (D.T[None] * points.sigma_d[:, None] ** 2) @ D + points.v_b_covariance
        R = R + cross_variance(points.omega_sigma, lever_arm)[:, None, None] * np.eye(3)
        weighted = np.linalg.solve(R, H)
        return _Sums(
            self.information + np.einsum("mij,mik->jk", weighted, H),
            self.by_rotation + np.einsum("mij,mk->jki", weighted, points.v_d),
            self.by_body + np.einsum("mij,mi->j", weighted, points.v_b),
        )

    def vector(self, D: Array) -> Array:
        """Return b(D), (7,)."""
        return np.einsum("jki,ki->j", self.by_rotation, D) - self.by_body

    def vector_by_turn(self, D: Array) -> Array:
        """Return the derivative of b(D Exp(a)) with respect to a at zero, (7, 3)."""
        return np.einsum("jki,aki->ja", self.by_rotation, D @ skew(np.eye(3)))


def _filter(
    points: Points, prior: Estimated, start: Array
) -> tuple[_Sums, tuple[tuple[float, Estimated], ...]]:
    """Return the sums over all pings, and the estimate after those of a history."""
    sums = _Sums(np.zeros((7, 7)), np.zeros((7, 3, 3)), np.zeros(7))
    at, square = start, prior.values[2] ** 2 + prior.covariance.diagonal()[4:]
    history, done = [], 0
    for row in history_rows(len(points)).tolist():
        sums = sums.and_(points.take(slice(done, row + 1)), at, square)
        done = row + 1
        estimated, _ = _step(sums, prior, at)
        at = estimated.values[0]
        square = estimated.values[2] ** 2 + np.maximum(estimated.covariance.diagonal()[4:], 0.0)
        history.append((float(points.time[row]), estimated))
    return sums, tuple(history)


def _near(prior: Estimated, D: Array) -> Estimated:
    """Return a prior whose misalignment is near a rotation.

    The first pings, at rest, would mislead the filter.
    """
    covariance = prior.covariance.copy()
    covariance[:3, :3] = _WIDE**2 * np.eye(3)
    return Estimated(prior.parameters, (D, *prior.values[1:]), covariance)


def _settle(sums: _Sums, prior: Estimated, at: Array) -> tuple[Estimated, bool]:
    """Return the estimate at which steps end, and whether there is one."""
    for _ in range(_STEPS):
        estimated, moved = _step(sums, prior, at)
        at = estimated.values[0]
        if moved < _SETTLED:
            return estimated, True
    return estimated, False


def _step(sums: _Sums, prior: Estimated, D: Array) -> tuple[Estimated, float]:
    """Return the estimate that a Newton step from a rotation leads to, and the largest turn.

    The turn is in standard deviations. What multiplies omega in the data is (1 + k) l, and so
    with the angle that is left; the prior stays where it is.
    """
    known = prior.covariance.diagonal() == 0.0
    free = ~known
    is_wide = np.sqrt(prior.covariance.diagonal()[:3].max()) > _WIDE
    left = np.zeros(3) if is_wide else log_so3(D.T @ prior.values[0])
    mean = np.concatenate([left, prior.values[1], prior.values[2]])
    of_prior = np.zeros((7, 7))
    of_prior[np.ix_(free, free)] = np.linalg.inv(prior.covariance[np.ix_(free, free)])
    jacobian = sums.information.copy()
    jacobian[:, :3] = -sums.vector_by_turn(D)
    jacobian = jacobian + of_prior
    right = sums.vector(D) + of_prior @ mean - jacobian[:, known] @ mean[known]
    x, P = mean.copy(), np.zeros((7, 7))
    gain = np.linalg.inv(jacobian[np.ix_(free, free)])
    x[free] = gain @ right[free]
    # The equations that are solved are not those of least squares: their scatter is A.
    scatter = (sums.information + of_prior)[np.ix_(free, free)]
    P[np.ix_(free, free)] = gain @ scatter @ gain.T
    turn = x[:3] / max(1.0 + x[3], 0.1)
    turn *= min(1.0, _LONGEST / max(float(np.linalg.norm(turn)), 1e-12))
    factor = max(1.0 + x[3], 0.1)
    J = np.eye(7)
    J[:3, :3] /= factor
    J[4:, 4:] /= factor
    J[4:, 3] = -x[4:] / factor**2
    P = J @ P @ J.T
    P[known] = P[:, known] = 0.0
    values = (D @ exp_so3(turn), x[3:4], np.where(known[4:], mean[4:], x[4:] / factor))
    sigma = np.sqrt(np.maximum(P.diagonal()[:3], 1e-24))
    return Estimated(prior.parameters, values, P), float(np.max(np.abs(turn) / sigma))
