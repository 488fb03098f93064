"""Unit vectors near nominal ones."""

from __future__ import annotations

import numpy as np
from jacobians import differentiate

from factorgraph_dvl.geometry.unit_vectors import (
    tangent_axes,
    turned,
    turned_jacobian,
    turns_to,
)

RNG = np.random.default_rng(1)
NOMINAL = np.vstack([RNG.normal(size=(20, 3)), [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
NOMINAL /= np.linalg.norm(NOMINAL, axis=1, keepdims=True)
ETA = np.vstack([RNG.normal(0.0, 0.7, (21, 2)), [[0.0, 0.0]]])


def test_axes_are_perpendicular_to_the_nominal_vector_and_to_each_other():
    E = tangent_axes(NOMINAL)
    np.testing.assert_allclose(np.einsum("nij,ni->nj", E, NOMINAL), 0.0, atol=1e-15)
    np.testing.assert_allclose(
        E.transpose(0, 2, 1) @ E, np.tile(np.eye(2), (22, 1, 1)), atol=1e-14
    )


def test_vectors_are_turned_by_the_length_of_their_coordinates():
    d = turned(NOMINAL, ETA)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1.0)
    angle = np.arccos(np.clip(np.sum(d * NOMINAL, axis=1), -1.0, 1.0))
    np.testing.assert_allclose(angle, np.linalg.norm(ETA, axis=1), atol=1e-7)
    np.testing.assert_allclose(turns_to(NOMINAL, 3.0 * d), ETA, atol=1e-12)


def test_derivatives_are_those_of_differences():
    for eta in (ETA, 1e-4 * ETA, 0.0 * ETA):
        numerical = differentiate(lambda h, eta=eta: turned(NOMINAL, eta + h), 2)
        np.testing.assert_allclose(turned_jacobian(NOMINAL, eta), numerical, atol=1e-9)
