"""The printed filter of gyro drift: its drift is constant in n."""

from __future__ import annotations

import numpy as np
from truth import config

from factorgraph_dvl.baselines import kalman
from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.simulation import simulate

DRIFTS = np.array([0.05, 0.1, 0.2])


def test_a_vessel_that_heads_elsewhere_than_north_gets_a_rotated_drift():
    trial = simulate(config("star"), 0)
    printed = kalman(trial, "liu-2020").estimate("gyro_bias_deg_h")
    nRb = rotation_from_rph(np.array([0.0, 0.0, np.radians(40.0)]), "RFU")
    np.testing.assert_allclose(printed.value, nRb @ DRIFTS, atol=4.0 * printed.std[0])
    assert np.abs(printed.value - DRIFTS).max() > 10.0 * printed.std[0]


def test_a_vessel_that_heads_north_gets_the_drift_of_its_gyros():
    printed = kalman(simulate(config("star", start={"heading_deg": 0}), 0), "liu-2020")
    found = printed.estimate("gyro_bias_deg_h")
    assert np.all(np.abs(found.value - DRIFTS) < 4.0 * found.std)


def test_the_printed_star_vectors_give_a_solution():
    trial = simulate(config("liu-2020-vectors"), 0)
    found = kalman(trial, "star").estimate("gyro_bias_deg_h")
    assert np.all(np.abs(found.value - DRIFTS) < 4.0 * found.std)


def test_the_dive_with_stars_is_a_scenario():
    scenario = config("dive-stars")
    assert scenario.star is not None
    assert scenario.star.outages_s == ((305.0, 3880.0),)
