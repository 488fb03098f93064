"""Vectors in arrays: products and interpolation."""

import numpy as np
import pytest

from factorgraph_dvl.geometry.vectors import cross, interpolate, median, rotate, skew

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


@pytest.mark.parametrize("size", [1, 2, 7, 8])
def test_the_median_is_numpys(size):
    values = np.random.default_rng(size).standard_normal(size)
    assert median(values) == np.median(values)


def test_products_with_few_vectors_are_those_with_many():
    rng = np.random.default_rng(3)
    matrices, vectors = rng.standard_normal((300, 3, 3)), rng.standard_normal((300, 3))
    few = [
        rotate(m, v) for m, v in zip(np.split(matrices, 60), np.split(vectors, 60), strict=True)
    ]
    np.testing.assert_allclose(np.concatenate(few), rotate(matrices, vectors), atol=1e-14)
    np.testing.assert_allclose(
        rotate(matrices[:5], vectors[0]), matrices[:5] @ vectors[0], atol=1e-14
    )
