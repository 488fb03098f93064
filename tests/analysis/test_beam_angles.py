"""Angles of beams: those of the patent's formula, with standard deviations by differences."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.analysis.beam_angles import beam_angles
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.rotations import frd_from_body
from factorgraph_dvl.sensors.dvl_beams import DvlBeamsSettings
from factorgraph_dvl.solution import Calibration

ALPHA_THETA = [[20.0, 60.0], [22.0, 58.0], [19.0, 61.0], [21.0, 59.0]]


def calibration(eta, covariance, axes="RFU"):
    nominal = DvlBeamsSettings(alpha_theta_deg=ALPHA_THETA).nominal_d
    if axes == "FRD":
        nominal = nominal @ frd_from_body("RFU").T
    names = tuple(f"beam_direction_{i}{c}_deg" for i in range(1, 5) for c in "xy")
    std = np.sqrt(np.diag(covariance))
    e = Estimate(
        "beam_direction_deg", names, eta, std, np.zeros(8), np.ones(8), np.ones(8, bool), nominal
    )
    return Calibration(
        trial="t", solver="s", body_axes=axes, converged=True, iterations=1, cost=0.0,
        estimates=(e,), covariance=covariance,
    )  # fmt: skip


@pytest.mark.parametrize("axes", ["RFU", "FRD"])
def test_nominal_beams_have_the_angles_that_they_were_given(axes):
    found = beam_angles(calibration(np.zeros(8), 1e-6 * np.eye(8), axes))
    expected = np.array(ALPHA_THETA)
    np.testing.assert_allclose(found.alpha, expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(found.theta, expected[:, 1], atol=1e-9)
    np.testing.assert_allclose(found.alpha_nominal, found.alpha, atol=1e-9)
    assert list(found.columns())[:3] == ["beam", "alpha_deg", "alpha_std_deg"]


def test_standard_deviations_are_those_of_drawn_turns():
    rng = np.random.default_rng(0)
    root = rng.normal(0.0, 0.02, (8, 8))
    P = root @ root.T
    eta = rng.normal(0.0, 0.5, 8)
    found = beam_angles(calibration(eta, P))
    drawn = [
        beam_angles(calibration(eta + x, P)) for x in rng.multivariate_normal(np.zeros(8), P, 500)
    ]
    for name in ("alpha", "theta"):
        std = np.std([getattr(d, name) for d in drawn], axis=0)
        np.testing.assert_allclose(getattr(found, f"{name}_std"), std, rtol=0.15)


def test_without_beams_there_are_none():
    bare = calibration(np.zeros(8), np.eye(8))
    bare = Calibration(**{n: getattr(bare, n) for n in bare.__dataclass_fields__} | {
        "estimates": (), "covariance": np.zeros((0, 0)),
    })  # fmt: skip
    assert beam_angles(bare) is None
