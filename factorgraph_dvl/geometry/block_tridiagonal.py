"""Symmetric block-tridiagonal matrices: SciPy's banded form, and blocks of their inverse."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.vectors import Array


def banded(diagonal: Array, off: Array) -> Array:
    """Return a symmetric block-tridiagonal matrix in SciPy's upper banded form.

    Parameters
    ----------
    diagonal : ndarray, shape (K, n, n)
        Blocks on the diagonal.
    off : ndarray, shape (K - 1, n, n)
        Blocks A_k,k+1 above it.

    Returns
    -------
    ndarray, shape (2 n, K n)
        What `scipy.linalg.cholesky_banded` takes.
    """
    n, size = diagonal.shape[:2]
    above = 2 * size - 1
    out = np.zeros((above + 1, n * size))
    for i in range(size):
        for j in range(size):
            if j >= i:
                out[above + i - j, j::size] = diagonal[:, i, j]
            out[above - size + i - j, size + j :: size] = off[:, i, j]
    return out


def inverse_blocks(diagonal: Array, off: Array) -> tuple[Array, Array]:
    """Return the blocks of the inverse P of a symmetric block-tridiagonal matrix A.

    They follow from the ends: with the Schur complements F from the front, P_KK = F_K⁻¹, and
    backwards with G = F_k⁻¹ A_k,k+1

        P_k,k+1 = -G P_k+1,k+1,    P_kk = F_k⁻¹ + G P_k+1,k+1 Gᵀ.

    Parameters
    ----------
    diagonal, off : ndarray, shape (K, n, n) or (K - 1, n, n)
        As in `banded`.

    Returns
    -------
    own : ndarray, shape (K, n, n)
        P_kk.
    across : ndarray, shape (K - 1, n, n)
        P_k,k+1.
    """
    own = np.empty_like(diagonal)
    own[0] = np.linalg.inv(diagonal[0])
    for k, before in enumerate(off):
        own[k + 1] = np.linalg.inv(diagonal[k + 1] - before.T @ own[k] @ before)
    gain = own[:-1] @ off
    for k in range(len(off) - 1, -1, -1):
        own[k] += gain[k] @ own[k + 1] @ gain[k].T
    return own, -gain @ own[1:]
