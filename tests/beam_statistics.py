"""Statistics of calibrated beams."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.analysis.error_statistics import calibration_errors


def nees_of(solution, truth):
    errors = calibration_errors(solution, truth)
    rows = [i for i, name in enumerate(errors.names) if "bias" not in name]
    P = errors.covariance[np.ix_(rows, rows)]
    std = np.sqrt(np.diag(P))
    z = errors.error[rows] / std
    return float(z @ np.linalg.solve(P / np.outer(std, std), z)), len(rows)
