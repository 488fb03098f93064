"""Simulated depth sensor."""

from __future__ import annotations

from typing import cast

import numpy as np

from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.depth import Depth, DepthSettings
from factorgraph_dvl.simulation.instruments import DepthTruth, ScenarioView
from factorgraph_dvl.simulation.measurements import displaced, sample_times
from factorgraph_dvl.simulation.motion import TrueMotion


def simulate_depth(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[Depth, dict[str, Array]]:
    """Return the sensor's record, and the height of the sea surface by reported name.

    The depth is the distance of the sensor, at its lever arm from the IMU, below the sea
    surface.
    """
    truth: DepthTruth = scenario.depth
    jitter_rng, noise_rng = rng.spawn(2)
    time = sample_times(truth, motion.duration, jitter_rng)
    state = motion.at(time)
    arm_n = rotation_from_rph(state.rph, scenario.body_axes) @ np.array(truth.lever_arm_m)
    depth = truth.sea_surface_height_m - displaced(state.geodetic, arm_n)[:, 2]
    if scenario.noise:
        depth = depth + truth.std_m * noise_rng.standard_normal(depth.shape)
    record = Depth(
        settings=cast("DepthSettings", scenario.settings("depth")), time=time, depth=depth
    )
    return record, {"sea_surface_height_m": np.array([truth.sea_surface_height_m])}
