"""The point sets by differential evolution, in place of particle swarms and genetic algorithms.

Li et al. (2022) search the rotation between the point sets by a particle swarm, Liu et al. (2022)
by a genetic algorithm: populations that need neither derivatives nor a start. So does SciPy's
`differential_evolution`, over rotation vector, scale and lever arm within three prior standard
deviations. With u = [v_b, omega],

    v_d = A u,    A = (1 + k) R [I, -[l x]],

the cost needs nothing but sums of squares of the pings, whatever their number. A population has
no covariance.

R. Storn and K. Price, Differential evolution, J. Global Optimization 11, 341-359, 1997. D. Li et
al., Measurement 187, 110325, 2022. J. X. Liu et al., IEEE Sensors Journal 22(10), 9558-9567, 2022.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import Bounds, differential_evolution

from factorgraph_dvl.baselines.outcome import Outcome, prior_of
from factorgraph_dvl.baselines.point_sets import Points
from factorgraph_dvl.baselines.residual_covariance import by_residuals, point_weights
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array, skew
from factorgraph_dvl.sensors.parameters import Parameter

# Chosen: prior standard deviations that a member of the population may be off, generations at
# most, and the standard deviation of the costs of a population, squares of normalised residuals,
# that ends the search.
_REACH = 3.0
_GENERATIONS = 1000
_SPREAD = 1e-3


def evolved(
    points: Points, misalignment: Parameter, scale: Parameter, lever_arm: Parameter
) -> Outcome:
    """Calibrate by differential evolution.

    Parameters
    ----------
    points : Points
        The two point sets.
    misalignment, scale, lever_arm : Parameter
        Misalignment, scale and lever arm with their priors; one scale for the three axes.
    """
    parameters = (misalignment, scale, lever_arm)
    mean = np.concatenate([p.mean for p in parameters])
    sigma = np.concatenate([p.sigma for p in parameters])
    reach = _REACH * sigma
    reach[:3] = np.minimum(reach[:3], np.pi)
    free = np.flatnonzero(reach > 0.0)
    weight = point_weights(points)
    if not free.size or not len(points):
        return Outcome(prior_of(parameters), 1)
    both = np.hstack([points.v_b, points.omega_b])
    of_body = (both * weight[:, None]).T @ both
    mixed = (points.v_d * weight[:, None]).T @ both
    of_dvl = float(weight @ np.sum(points.v_d**2, axis=1))

    def cost(x: Array, /) -> Any:
        """Return the costs of a population, (F, S)."""
        full = np.repeat(mean[:, None], x.shape[1], axis=1)
        full[free] = x
        off = ((full - mean[:, None])[free] / sigma[free, None]) ** 2
        A = (1.0 + full[3])[:, None, None] * exp_so3(full[:3].T)
        A = np.concatenate([A, -A @ skew(full[4:].T)], axis=2)
        square = np.einsum("sij,jk,sik->s", A, of_body, A, optimize=True)
        return square - 2.0 * np.einsum("sij,ij->s", A, mixed) + of_dvl + off.sum(axis=0)

    found = differential_evolution(
        cost,
        Bounds((mean - reach)[free], (mean + reach)[free]),
        # The greedy strategy that is SciPy's default ends in a wrong rotation three times in 13.
        strategy="rand1exp",
        rng=0,
        maxiter=_GENERATIONS,
        tol=0.0,
        atol=_SPREAD,
        polish=False,
        vectorized=True,
        updating="deferred",
    )
    full = mean.copy()
    full[free] = found.x
    values = (exp_so3(full[:3]), full[3:4], full[4:])
    estimated = by_residuals(points, parameters, values, lever_arm.mean)
    return Outcome(estimated, int(found.nit), converged=bool(found.success))
