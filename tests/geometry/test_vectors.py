"""Vectors in arrays: products and interpolation."""

import numpy as np
import pytest

from factorgraph_dvl.geometry.vectors import cross, interpolate, rotate, skew

RNG = np.random.default_rng(3)


def test_cross_products_three_ways():
    a, b = RNG.standard_normal((2, 4, 3))
    assert cross(a, b) == pytest.approx(np.cross(a, b))
    assert rotate(skew(a), b) == pytest.approx(np.cross(a, b))


def test_one_vector_by_many_matrices():
    matrices, v = RNG.standard_normal((4, 3, 3)), RNG.standard_normal(3)
    assert rotate(matrices, v) == pytest.approx(np.array([m @ v for m in matrices]))


@pytest.mark.parametrize("shape", [(), (3,), (2, 2)])
def test_interpolation_is_linear_between_knots_and_constant_beyond(shape):
    knots = np.array([0.0, 1.0, 3.0])
    slope = RNG.standard_normal(shape)
    values = np.multiply.outer(knots, slope)
    found = interpolate(np.array([-1.0, 0.5, 2.0, 4.0]), knots, values)
    assert found == pytest.approx(np.multiply.outer([0.0, 0.5, 2.0, 3.0], slope))
