"""Angles of calibrated beams as the patent of Harbin Engineering University has them.

alpha_i is the angle between beam i and the yz plane of the body, theta_i that between it and the
xy plane, in axes right, forward, up: |d_x| = sin alpha, d_z = -sin theta.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.rotations import frd_from_body
from factorgraph_dvl.geometry.unit_vectors import turned, turned_jacobian
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.solution import Calibration, Solution

# Rows: right, forward, up; columns: forward, right, down.
_RFU_FROM_FRD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class BeamAngles:
    """Angles of N beams, deg.

    Parameters
    ----------
    alpha, theta : ndarray, shape (N,), deg
        Angles to the yz plane and to the xy plane, of the calibrated beams.
    alpha_std, theta_std : ndarray, shape (N,), deg
        Their standard deviations.
    alpha_nominal, theta_nominal : ndarray, shape (N,), deg
        Angles of the nominal beams.
    """

    alpha: Array
    theta: Array
    alpha_std: Array
    theta_std: Array
    alpha_nominal: Array
    theta_nominal: Array

    def columns(self) -> dict[str, Array]:
        """Return the angles as a table, a row for each beam."""
        number = np.arange(1.0, self.alpha.size + 1.0)
        names = ("alpha", "alpha_std", "alpha_nominal", "theta", "theta_std", "theta_nominal")
        return {"beam": number, **{f"{name}_deg": getattr(self, name) for name in names}}


def beam_angles(solution: Solution | Calibration) -> BeamAngles | None:
    """Return the angles of the beams that a solution calibrates; None if it calibrates none."""
    found = [e for e in solution.estimates if e.nominal is not None]
    if not found:
        return None
    e = found[0]
    assert e.nominal is not None
    to_rfu = _RFU_FROM_FRD @ frd_from_body(solution.body_axes)
    eta = e.value.reshape(-1, 2) * DEG
    directions = turned(e.nominal, eta) @ to_rfu.T
    alpha, theta = _angles(directions)
    by_turn = to_rfu @ turned_jacobian(e.nominal, eta)
    by_x = np.sign(directions[:, :1]) * by_turn[:, 0] / np.cos(alpha)[:, None]
    by_z = -by_turn[:, 2] / np.cos(theta)[:, None]
    rows = [list(solution.order).index(name) for name in e.component_names]
    P = solution.covariance[np.ix_(rows, rows)]
    own = np.stack([P[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] for i in range(len(eta))])
    std = [np.sqrt(np.einsum("ni,nij,nj->n", by, own, by)) for by in (by_x, by_z)]
    nominal = [a / DEG for a in _angles(e.nominal @ to_rfu.T)]
    return BeamAngles(alpha / DEG, theta / DEG, std[0], std[1], *nominal)


def _angles(directions: Array) -> tuple[Array, Array]:
    """Return alpha and theta of unit vectors (N, 3) in axes right, forward, up, rad."""
    return np.arcsin(np.abs(directions[:, 0])), np.arcsin(-directions[:, 2])
