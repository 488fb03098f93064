"""Shapes that a search found: what their search and lasting noise cost a test."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.sensors.dvl_water import WATER_SPAN_SPEC
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.solvers.shape import Shape, searched
from factorgraph_dvl.statistics.scores import Score

SPAN = Parameter(WATER_SPAN_SPEC, np.array([10.0, 20.0]), np.zeros(2))


def test_a_test_pays_for_its_search_and_for_what_persists():
    """By hand: 80 / 4 - 2 ln 1000 = 20 - 13.8 = 6.18."""
    test = Score(80.0, 2, np.ones(2), np.ones(2))
    found = searched(test, "water", {"water": Shape(SPAN, 1000, 4.0)})
    assert found.chi2 == pytest.approx(6.184, abs=1e-3)
    np.testing.assert_allclose(found.std, 2.0)


def test_a_parameter_without_a_shape_is_tested_as_it_is():
    test = Score(80.0, 2, np.ones(2), np.ones(2))
    assert searched(test, "scale", {"water": Shape(SPAN, 1000, 4.0)}) is test
