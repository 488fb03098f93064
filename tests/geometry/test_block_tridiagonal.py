import numpy as np
import pytest
from scipy.linalg import cho_solve_banded, cholesky_banded

from factorgraph_dvl.geometry.block_tridiagonal import banded, inverse_blocks


@pytest.mark.parametrize("count", [1, 2, 5])
def test_solution_and_blocks_of_the_inverse_are_those_of_the_dense_matrix(count):
    rng = np.random.default_rng(count)
    size = 3
    diagonal = rng.normal(size=(count, size, 2 * size))
    diagonal = diagonal @ diagonal.transpose(0, 2, 1) + 6.0 * np.eye(size)
    off = rng.normal(size=(count - 1, size, size))
    dense = np.zeros((count * size, count * size))
    blocks = dense.reshape(count, size, count, size)
    for k in range(count):
        blocks[k, :, k] = diagonal[k]
    for k in range(count - 1):
        blocks[k, :, k + 1], blocks[k + 1, :, k] = off[k], off[k].T
    right = rng.normal(size=(count * size, 2))
    factor = cholesky_banded(banded(diagonal, off))
    solution = cho_solve_banded((factor, False), right)
    np.testing.assert_allclose(solution, np.linalg.solve(dense, right), atol=1e-12)
    inverse = np.linalg.inv(dense).reshape(count, size, count, size)
    own, across = inverse_blocks(factor, size)
    for k in range(count):
        np.testing.assert_allclose(own[k], inverse[k, :, k], atol=1e-12)
    for k in range(count - 1):
        np.testing.assert_allclose(across[k], inverse[k, :, k + 1], atol=1e-12)
