"""Average information: how the restricted likelihood bends by the logarithms of variances.

With whitened residuals r = (I - H) y of all rows, and a variance theta_i of which rows a have the
share D_i, the restricted likelihood has the score and the average of observed and expected
information

    d(-2 log L) / d log theta_i = sum D_i (1 - h) - sum D_i r²
    A_ij = (D_i r)ᵀ (I - H) (D_j r),

of which the second asks for one pass through the tree for all strengths together (Gilmour,
Thompson and Cullis, Average information REML, Biometrics 51(4), 1995). Steps A⁻¹ times the score
converge like Newton's, where a fixed point sum D_i r² / sum D_i (1 - h) takes the longer, the
fewer degrees of freedom are left of many.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.problem import Rows
from factorgraph_dvl.statistics.rows import add_transposed_product
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation


@dataclass(frozen=True)
class SharedRows:
    """Rows, and which strength makes how much of their variance.

    Parameters
    ----------
    rows : Rows
        M items of d rows.
    number : ndarray of int, shape (M, d)
        Strength of each row, -1 where it has none.
    share : ndarray, shape (M, d)
        Share of its variance that the strength makes.
    leverage : ndarray, shape (M, d)
        How far its residual follows its measurement.
    """

    rows: Rows
    number: IntArray
    share: Array
    leverage: Array


@dataclass(frozen=True)
class RestrictedScore:
    """What residuals say of m strengths.

    Parameters
    ----------
    squares, freedom : ndarray, shape (m,)
        Squares of the residuals that each has, and what they would be.
    information : ndarray, shape (m, m)
        Average information on the logarithms of the variances, of -2 log of the likelihood.
    """

    squares: Array
    freedom: Array
    information: Array


def restricted_score(
    parts: Sequence[SharedRows], count: int, information: SquareRootInformation
) -> RestrictedScore:
    """Return score and average information of strengths.

    Parameters
    ----------
    parts : sequence of SharedRows
        All rows that have one of them; rows that are not used are zero.
    count : int
        How many strengths there are.
    information : SquareRootInformation
        Square-root information of all variables.
    """
    squares, freedom, own = np.zeros((3, count))
    sums: dict[int, Array] = {}
    for part in parts:
        known = part.number >= 0
        used = known & np.any(part.rows.matrix, axis=2)
        number, share = part.number[used], part.share[used]
        residual = share * part.rows.vector[used]
        np.add.at(squares, number, residual * part.rows.vector[used])
        np.add.at(freedom, number, share * (1.0 - part.leverage[used]))
        np.add.at(own, number, residual**2)
        factors = np.zeros((*part.number.shape, count))
        factors[(*np.nonzero(used), number)] = residual
        add_transposed_product(part.rows, factors, sums)
    bend = np.diag(own)
    if sums:
        bend = bend - information.covariance_of([sums])
    return RestrictedScore(squares, freedom, bend)
