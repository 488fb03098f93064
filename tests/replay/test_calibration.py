"""The calibration at one moment, as it is reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG, DEG_PER_HOUR, MICRO_G
from factorgraph_dvl.replay.calibration import CalibrationReport
from factorgraph_dvl.sensors.dvl import LEVER_ARM_SPEC, MISALIGNMENT_SPEC, SCALE_SPEC
from factorgraph_dvl.sensors.imu import Imu, ImuSettings
from factorgraph_dvl.sensors.parameters import Parameter

PARAMETERS = (
    Parameter(SCALE_SPEC, np.array([0.01]), np.array([0.1])),
    Parameter(MISALIGNMENT_SPEC, np.array([0.0, 0.0, 30.0]) * DEG, np.full(3, 10.0) * DEG),
    Parameter(LEVER_ARM_SPEC, np.array([1.0, 2.0, 3.0]), np.array([2.0, 3.0, 4.0])),
)
TRUE = np.array([1.0, -2.0, 29.0])
VALUES = {
    "scale_error": np.array([0.005]),
    "misalignment_deg": exp_so3(TRUE * DEG),
    "lever_arm_m": np.array([1.1, 1.9, 3.2]),
}
# Accelerometer bias, gyro bias, then the parameters as they stand.
SIGMA = np.array([*[1e-4] * 3, *[1e-7] * 3, 1e-3, *[0.02] * 3, *[0.3] * 3])


@pytest.fixture
def biases():
    settings = ImuSettings(
        gyro_noise_deg_sqrt_h=0.01,
        gyro_bias_std_deg_h=1.0,
        accel_noise_ug_sqrt_hz=100.0,
        accel_bias_std_ug=1000.0,
    )
    zero = np.zeros((2, 3))
    gyro, accel = Imu(settings, np.arange(2.0), zero, zero).parameters(0.0)
    return (gyro, np.full(3, 0.2 * DEG_PER_HOUR)), (accel, np.full(3, 30.0 * MICRO_G))


def reported(parameters, values, biases, P, undetermined):
    (gyro, gyro_bias), (accel, accel_bias) = biases
    bias = np.concatenate([accel_bias, gyro_bias])
    return CalibrationReport(parameters, gyro, accel).at(values, bias, P, undetermined)


def test_values_and_deviations_are_in_the_units_and_the_order_of_reports(biases):
    none = np.zeros((7, 0))
    found = reported(PARAMETERS, VALUES, biases, np.diag(SIGMA**2), none)
    names = [e.name for e in found.estimates]
    assert names[:3] == ["misalignment_deg", "scale_error", "lever_arm_m"]
    by_name = {e.name: e for e in found.estimates}
    np.testing.assert_allclose(by_name["misalignment_deg"].value, TRUE, atol=1e-9)
    np.testing.assert_allclose(by_name["lever_arm_m"].std, 0.3)
    np.testing.assert_allclose(by_name["gyro_bias_deg_h"].value, 0.2)
    np.testing.assert_allclose(by_name["gyro_bias_deg_h"].std, 1e-7 / DEG_PER_HOUR)
    np.testing.assert_allclose(by_name["accel_bias_ug"].std, 1e-4 / MICRO_G)
    std = np.concatenate([e.std for e in found.estimates])
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), std)


def test_along_an_undetermined_direction_the_prior_is_reported(biases):
    # The second component of the lever arm, which the biases are correlated with.
    fixed = np.zeros((7, 1))
    fixed[5] = 1.0
    P = np.diag(SIGMA**2)
    P[0, 11] = P[11, 0] = 0.5 * SIGMA[0] * SIGMA[11]
    found = reported(PARAMETERS, VALUES, biases, P, fixed)
    by_name = {e.name: e for e in found.estimates}
    arm = by_name["lever_arm_m"]
    np.testing.assert_allclose(arm.value, [1.1, 2.0, 3.2], atol=1e-12)
    np.testing.assert_allclose(arm.std, [0.3, 3.0, 0.3])
    # Fixing a direction makes no bias better known.
    np.testing.assert_allclose(by_name["accel_bias_ug"].std, 1e-4 / MICRO_G)
    # Parameters that are independent of it stay.
    np.testing.assert_allclose(by_name["misalignment_deg"].value, TRUE, atol=1e-9)


def test_a_parameter_that_is_not_estimated_is_exact(biases):
    known = (replace(PARAMETERS[0], sigma=np.zeros(1)), *PARAMETERS[1:])
    values = VALUES | {"scale_error": known[0].mean}
    P = np.diag(np.delete(SIGMA, 6) ** 2)
    found = reported(known, values, biases, P, np.zeros((6, 0)))
    (scale,) = [e for e in found.estimates if e.name == "scale_error"]
    assert (scale.value[0], scale.std[0]) == (0.01, 0.0)
