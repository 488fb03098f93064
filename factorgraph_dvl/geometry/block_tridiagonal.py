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


def inverse_blocks(factor: Array, size: int) -> tuple[Array, Array]:
    """Return the blocks of the inverse P of a symmetric block-tridiagonal matrix A.

    They follow from the end: with A = Uᵀ U and G = U_kk⁻¹ U_k,k+1

        P_k,k+1 = -G P_k+1,k+1,    P_kk = U_kk⁻¹ U_kk⁻ᵀ + G P_k+1,k+1 Gᵀ.

    Parameters
    ----------
    factor : ndarray, shape (2 n, K n)
        U in banded form, as `scipy.linalg.cholesky_banded` returns it.
    size : int
        Size n of a block.

    Returns
    -------
    own : ndarray, shape (K, n, n)
        P_kk.
    across : ndarray, shape (K - 1, n, n)
        P_k,k+1.
    """
    count = factor.shape[1] // size
    above = 2 * size - 1
    root, beside = np.zeros((count, size, size)), np.empty((count - 1, size, size))
    for i in range(size):
        for j in range(size):
            if j >= i:
                root[:, i, j] = factor[above + i - j, j::size]
            beside[:, i, j] = factor[above - size + i - j, size + j :: size]
    root = np.asarray(np.linalg.inv(root), dtype=np.float64)
    gain = root[:-1] @ beside
    own = root @ root.transpose(0, 2, 1)
    after = own[-1]
    for each, through in zip(own[-2::-1], gain[::-1], strict=True):
        each += through.dot(after).dot(through.T)
        after = each
    return own, -gain @ own[1:]
