"""Polynomials through IMU samples, and what they integrate to."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.imu.polynomials import (
    evaluate,
    highest_difference,
    integrate,
    interpolation,
    rate_and_slope,
    regular_interpolations,
)


@pytest.mark.parametrize("averaged", [False, True])
def test_samples_of_a_polynomial_give_its_coefficients(averaged):
    c = np.array([2.0, -1.0, 0.5, 3.0])
    edges = np.array([-1.0, 0.0, 0.7, 2.0, 2.5])
    power = np.arange(4)
    if averaged:
        integral = (edges[:, None] ** (power + 1) / (power + 1)) @ c
        samples = np.diff(integral) / np.diff(edges)
    else:
        edges = edges[:4]
        samples = edges[:, None] ** power @ c
    matrix = interpolation(edges[None], averaged)[0]
    np.testing.assert_allclose(matrix @ samples, c, atol=1e-12)


def test_regular_samples_have_one_matrix():
    expected = interpolation(np.array([[-1.0, 0.0, 1.0, 2.0]]), True)[0]
    np.testing.assert_array_equal(regular_interpolations(4, True)[1], expected)


def test_the_highest_difference_of_a_power_is_its_factorial():
    # Third differences of t³ at intervals of 0.1 are 3! 0.1³, whatever the irregularity.
    edges = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    found = highest_difference(edges[:, None] ** 3, edges, 4, False)
    np.testing.assert_allclose(found, 6e-3)
    means = np.diff(edges**4 / 4.0) / np.diff(edges)
    found = highest_difference(means[:, None], edges, 4, True)
    np.testing.assert_allclose(found, 6e-3)


def test_values_and_slopes_by_hand():
    c = np.zeros((1, 3, 6))
    c[0, :, 0] = [1.0, 2.0, 3.0]
    assert evaluate(c, np.array([2.0]))[0, 0] == 1.0 + 4.0 + 12.0
    # u = 0.5 of an interval of 0.1 s.
    rate, slope = rate_and_slope(c, np.array([0.05]), np.array([0.1]))
    assert rate[0, 0] == pytest.approx(1.0 + 1.0 + 0.75)
    assert slope[0, 0] == pytest.approx((2.0 + 3.0) / 0.1)


def test_a_constant_force_in_a_constant_turn():
    w, f, h = 0.5, 2.0, 0.1
    c = np.zeros((1, 1, 6))
    c[0, 0] = [0.0, 0.0, w, f, 0.0, 0.0]
    phi, dv = integrate(c, np.array([h]), 1.0)
    np.testing.assert_allclose(phi, [[0.0, 0.0, w * h]], atol=1e-15)
    expected = f / w * np.array([np.sin(w * h), 1.0 - np.cos(w * h), 0.0])
    np.testing.assert_allclose(dv, [expected], atol=1e-9)


def test_coning_is_of_the_textbook():
    # Rates a and b t about x and y: the rotation vector has -a b h³ / 12 about z... by hand,
    # phi = ∫w + 1/2 ∫∫ [w(t1), w(t2)], of which the z component is a b h³ / 12.
    a, b, h = 1.0, 2.0, 0.01
    c = np.zeros((1, 2, 6))
    c[0, 0, 0], c[0, 1, 1] = a, b * h
    phi, _ = integrate(c, np.array([h]), 1.0)
    np.testing.assert_allclose(phi[0, :2], [a * h, b * h**2 / 2.0], rtol=1e-4)
    assert abs(phi[0, 2]) == pytest.approx(a * b * h**3 / 12.0, rel=1e-3)
