"""The motion of a planar trial, with headings that are not too large by their constant error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_dvl.graph.planar_chain import PlanarChain
from factorgraph_dvl.solution import Trajectory
from factorgraph_dvl.solvers.fixed_directions import SolvedProblem


def planar_trajectory(found: SolvedProblem, chain: PlanarChain, rate_hz: float) -> Trajectory:
    """Return the motion at a rate, with its covariance.

    Parameters
    ----------
    found : SolvedProblem
        Of a planar chain, at its minimum.
    chain : PlanarChain
        Its chain.
    rate_hz : float
        Epochs in a second.
    """
    at, P = found.minimum.evaluation, found.covariances
    out = chain.trajectory(at.states, P.nodes, chain.body_axes, rate_hz)
    bias = chain.heading_bias
    if bias not in found.problem.columns:
        return out
    rph, rph_cov = out.rph.copy(), out.rph_cov.copy()
    rph[:, 2] = (rph[:, 2] - at.parameters[bias][0]) % (2.0 * np.pi)
    root = found.problem.prior_root[found.problem.columns[bias]][0]
    rph_cov[:, 2, 2] += root @ P.parameters @ root
    return replace(out, rph=rph, rph_cov=rph_cov)
