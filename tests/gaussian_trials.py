"""Results of trials drawn from their own covariances: no trial is solved."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.campaign.information import Information

SIGMA = np.array([0.03, 0.03, 0.03, 3e-4, 0.02, 0.02, 0.02])
PRIOR = np.array([180.0, 180.0, 180.0, 0.1, 10.0, 10.0, 10.0])
NAMES = tuple(f"component_{i}" for i in range(7))


def gaussian_trials(seed, shift, count=40):
    """Return the information of trials with correlated errors, moved by `shift` (count, 7)."""
    rng = np.random.default_rng(seed)
    matrix, weighted, square = [], [], []
    for move in np.broadcast_to(shift, (count, 7)):
        A = np.eye(7) + 0.5 * rng.standard_normal((7, 7)) / np.sqrt(7)
        C = A @ A.T
        std = SIGMA / np.sqrt(np.diag(C))
        P = C * np.outer(std, std)
        x = move + np.linalg.cholesky(P) @ rng.standard_normal(7)
        matrix.append(np.linalg.inv(P))
        weighted.append(matrix[-1] @ x)
        square.append(x @ weighted[-1])
    rank = np.full(count, 7)
    zero = np.zeros(7)
    return Information(
        NAMES, np.array(matrix), np.array(weighted), np.array(square), rank, zero, zero, PRIOR, ()
    )


def remount(after, size=0.1, count=40):
    """Return a step of the third misalignment after a trial, (count, 7)."""
    shift = np.zeros((count, 7))
    shift[after + 1 :, 2] = size
    return shift
