"""Parameters as they are reported."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.sensors.parameters import SCALAR, Parameter, ParameterSpec
from factorgraph_dvl.solvers.reported import estimates_of, in_order, in_unit


def parameter(stem, sigma, **options):
    sigma = np.array(sigma, dtype=float)
    return Parameter(ParameterSpec(stem, **options), np.zeros(sigma.size), sigma)


ANGLE = parameter("angle", [1.0, 1.0, 1.0], unit="deg", kind="rotation", place=1)
SCALE = parameter("scale", [0.1], labels=SCALAR, place=0)
FIXED = parameter("fixed", [0.0], labels=SCALAR, place=2)
LATE = parameter("late", [0.5], labels=SCALAR)
NEVER = parameter("never", [0.0], labels=SCALAR)


def test_the_order_is_by_place_then_what_was_estimated():
    rows = in_order([LATE, NEVER, FIXED, ANGLE, SCALE], lambda p: p)
    assert rows == [SCALE, ANGLE, FIXED, LATE]


def test_a_rotation_is_reported_in_degrees_with_the_derivative_there():
    small = np.array([1e-6, 0.0, 0.0])
    at = exp_so3([0.2, -0.1, 0.4])
    one, other = in_unit(ANGLE, at), in_unit(ANGLE, at @ exp_so3(small))
    np.testing.assert_allclose(one.value, np.array([0.2, -0.1, 0.4]) / DEG)
    np.testing.assert_allclose(other.value - one.value, one.derivative @ small, rtol=1e-5)


def test_what_was_not_estimated_has_no_covariance():
    rows = [(SCALE, np.array([0.01])), (FIXED, np.array([3.0])), (LATE, np.array([0.2]))]
    joint = np.array([[1e-6, 1e-5], [1e-5, 0.04]])
    (scale, fixed, late), covariance = estimates_of(rows, joint)
    np.testing.assert_allclose(covariance, [[1e-6, 0, 1e-5], [0, 0, 0], [1e-5, 0, 0.04]])
    assert (scale.std, fixed.std, late.std) == (1e-3, 0.0, 0.2)
    # At least halved: 0.1 to 0.001, 0.5 to 0.2.
    assert (scale.observable, fixed.observable, late.observable) == (True, False, True)


def test_a_component_that_is_fixed_stays_exact():
    partly = parameter("angle", [1.0, 0.0, 1.0], unit="deg")
    (estimate,), covariance = estimates_of([(partly, np.zeros(3))], np.ones((3, 3)))
    np.testing.assert_array_equal(covariance[1], 0.0)
    np.testing.assert_array_equal(estimate.std, [1.0, 0.0, 1.0])


def test_an_angle_is_reported_within_half_a_turn():
    bias = parameter("bias", [0.1], unit="deg", labels=SCALAR, kind="angle")
    np.testing.assert_allclose(in_unit(bias, np.array([190.0 * DEG])).value, [-170.0])
    plain = parameter("bias", [0.1], unit="deg", labels=SCALAR)
    np.testing.assert_allclose(in_unit(plain, np.array([190.0 * DEG])).value, [190.0])
