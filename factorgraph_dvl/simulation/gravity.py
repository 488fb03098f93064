"""The deflection of the vertical along a simulated track."""

from __future__ import annotations

import numpy as np
import pymap3d

from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.units import ARCSEC, STANDARD_GRAVITY
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.simulation.instruments import ScenarioView
from factorgraph_dvl.simulation.motion import TrueMotion

# Length over which the deflection changes, m. Chosen: some tens of kilometres.
_LENGTH = 2e4
# Waves of the geoid. Chosen: their sum is as good as normally distributed.
_WAVES = 1000
# Time between two places at which it is found, s. Chosen: no ship gets far meanwhile.
_STEP = 1.0
_FREEDOM = 5


def force_by_deflection(
    scenario: ScenarioView, motion: TrueMotion, time: Array, rng: np.random.Generator
) -> Array:
    """Return what the deflection of the vertical adds to the specific force, (N, 3), m/s².

    The geoid is a sum of plane waves of random direction, length and phase; the deflection is its
    slope.

    Parameters
    ----------
    scenario : Scenario
        Scenario with an IMU.
    motion : TrueMotion
        The motion.
    time : ndarray, shape (N,), s
        Times in order.
    rng : numpy.random.Generator
        Source of the numbers.
    """
    std = scenario.imu.gravity_deflection_std_arcsec * ARCSEC
    wave = rng.standard_normal((_WAVES, 2)) / np.sqrt(rng.chisquare(_FREEDOM, (_WAVES, 1)))
    phase = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    knots = np.append(np.arange(0.0, motion.duration, _STEP), motion.duration)
    geodetic = motion.at(knots).geodetic
    east, north, _ = pymap3d.geodetic2enu(*geodetic.T, *geodetic[0], deg=False)
    slope = np.zeros((knots.size, 2))
    for k, start in zip(wave, phase, strict=True):
        slope += np.sin((east * k[0] + north * k[1]) / _LENGTH + start)[:, None] * k
    slope *= std * np.sqrt(2.0 * (_FREEDOM - 2) / _WAVES)
    tilt = np.stack([np.interp(time, knots, each) for each in slope.T] + [np.zeros(time.size)])
    nRb = rotation_from_rph(motion.at(time).rph, scenario.body_axes)
    return np.asarray(-STANDARD_GRAVITY * np.einsum("nij,in->nj", nRb, tilt))
