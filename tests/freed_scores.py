"""Scores of parameters from an elimination in which they are free."""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.statistics.scores import Scores, places_of
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation


def scores(
    delta: gtsam.VectorValues,
    information: SquareRootInformation,
    candidates: Mapping[str, tuple[int, Array]],
) -> Scores:
    """Return scores and information of parameters that were taken as known.

    The graph contains them as variables with a wide prior, linearised where the fit without them
    ended, their priors' means being the values there. With P their covariance, the step delta
    to the minimum, and Lambda the information of the priors,

        I = P⁻¹ - Lambda,    S = P⁻¹ delta,    chi² = Sᵀ I⁻¹ S

    (Rao, Large sample tests of statistical hypotheses, 1948; Engle, Wald, likelihood ratio, and
    Lagrange multiplier tests in econometrics, 1984).

    Parameters
    ----------
    delta : gtsam.VectorValues
        Step to the minimum of the graph.
    information : SquareRootInformation
        Square-root information of the graph.
    candidates : mapping of str to tuple of (int, ndarray)
        Key and standard deviations (n,) of the wide prior, by name.
    """
    P = information.covariance_of(
        [{key: np.eye(sigma.size)} for key, sigma in candidates.values()]
    )
    sigma = np.concatenate([sigma for _, sigma in candidates.values()])
    step = np.concatenate([delta.at(key) for key, _ in candidates.values()])
    # In units of the wide priors, that parameters of all sizes keep their digits.
    whole = np.linalg.inv(P / np.outer(sigma, sigma))
    return Scores(
        places_of({name: sigma for name, (_, sigma) in candidates.items()}),
        whole @ (step / sigma) / sigma,
        (whole - np.eye(sigma.size)) / np.outer(sigma, sigma),
        sigma,
    )
