"""Simulated depth sensor."""

from __future__ import annotations

from typing import cast

import numpy as np

from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.depth import Depth, DepthSettings
from factorgraph_dvl.simulation.compass import first_order
from factorgraph_dvl.simulation.instruments import DepthTruth, ScenarioView
from factorgraph_dvl.simulation.measurements import displaced, sample_times
from factorgraph_dvl.simulation.motion import TrueMotion


def simulate_depth(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[Depth, dict[str, Array]]:
    """Return the sensor's record, and height of the sea surface and scale by reported name.

    The depth is the distance of the sensor, at its lever arm from the IMU, below the sea
    surface, by the density that the sensor supposes, and with an offset that changes slowly.
    """
    truth: DepthTruth = scenario.depth
    jitter_rng, noise_rng, slow_rng = rng.spawn(3)
    drawn = slow_rng.standard_normal() * truth.scale_error_std
    scale = drawn if truth.scale_error == "draw" else truth.scale_error
    time = sample_times(truth, motion.duration, jitter_rng)
    state = motion.at(time)
    arm_n = rotation_from_rph(state.rph, scenario.body_axes) @ np.array(truth.lever_arm_m)
    depth = truth.sea_surface_height_m - displaced(state.geodetic, arm_n)[:, 2]
    depth = (1.0 + scale) * depth
    if scenario.noise:
        slow = first_order(time, truth.correlation_time_s, slow_rng)[:, 0]
        depth = depth + truth.correlated_std_m * slow
        depth = depth + truth.std_m * noise_rng.standard_normal(depth.shape)
    record = Depth(
        settings=cast("DepthSettings", scenario.settings("depth")), time=time, depth=depth
    )
    return record, {
        "sea_surface_height_m": np.array([truth.sea_surface_height_m]),
        "depth_scale_error": np.array([scale]),
    }
