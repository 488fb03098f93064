"""Share of each part of a trial in the information on a parameter.

The marginal information L(t) on the constants, given the data up to time t, only grows. So
dL = L(end) - L(start) >= 0 is the contribution of a segment, and with the prior's L(0) the
parts add up to the whole. For component i with the final covariance P,

    1 = e_iᵀ P L P e_i / P_ii = sum over parts of (P e_i)ᵀ dL (P e_i) / P_ii.

Each part is also -d ln P_ii / dw if its information is weighted by w: the relative decrease
of the variance per relative increase of that part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.analysis.information.manoeuvres import Segment
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.statistics.information_history import InformationHistory


@dataclass(frozen=True)
class Shares:
    """Shares of the information on each component; they add up to 1.

    Parameters
    ----------
    names : tuple of str
        Names of the P components.
    prior : ndarray, shape (P,)
        Share of the prior.
    segments : ndarray, shape (S, P)
        Share of each segment.
    """

    names: tuple[str, ...]
    prior: Array
    segments: Array


def information_shares(history: InformationHistory, segments: Sequence[Segment]) -> Shares:
    """Return the shares of the prior and of each segment.

    Parameters
    ----------
    history : InformationHistory
        Information along the whole trial.
    segments : sequence of Segment
        Consecutive segments; data before the first and after the last count with these.
    """
    last = history.root[-1]
    P = last @ last.T
    # (P e_i)ᵀ L(t) (P e_i) with L(t) = (S Sᵀ)⁻¹, at the prior and at the ends of segments.
    ends = [np.searchsorted(history.time, s.end + 1e-6) - 1 for s in segments[:-1]]
    at = [0, *(int(np.clip(k, 0, None)) for k in ends), history.time.size - 1]
    known = np.stack([np.sum(np.linalg.solve(history.root[k], P) ** 2, axis=0) for k in at])
    known /= np.diag(P)
    return Shares(history.names, known[0], np.diff(known, axis=0))
