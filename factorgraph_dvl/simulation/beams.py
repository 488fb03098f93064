"""Simulated beams of a DVL, and the turntable that may carry it."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.sensors.dvl_beams import DvlBeams, DvlBeamsSettings
from factorgraph_dvl.sensors.turntable import Turntable, TurntableSettings
from factorgraph_dvl.simulation.instruments import DvlBeamsTruth, ScenarioView, TurntableTruth
from factorgraph_dvl.simulation.measurements import apply, mean_over, middles, sample_times, within
from factorgraph_dvl.simulation.motion import TrueMotion


def simulate_beams(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[DvlBeams, dict[str, Array]]:
    """Return the record of the beams, and their calibration by reported name.

    v_i = (1 + k_i) d_i . (v_b + omega_eb_b x l) + noise.
    """
    truth: DvlBeamsTruth = scenario.dvl_beams
    jitter_rng, error_rng, noise_rng, lost_rng = rng.spawn(4)
    directions, scale = _drawn(truth, error_rng)
    time = sample_times(truth, motion.duration, jitter_rng)
    time = middles(time, motion, truth.averaging_s)

    def at_times(when: Array, window: IntArray) -> Array:
        state = motion.at(when)
        bRn = np.swapaxes(rotation_from_rph(state.rph, scenario.body_axes), 1, 2)
        return apply(bRn, state.v_n) + np.cross(state.omega_eb_b, truth.lever_arm_m)

    at_dvl = mean_over(at_times, motion, time, truth.averaging_s)
    velocity = np.stack(
        [(1.0 + k) * (at_dvl @ d) for k, d in zip(scale, directions, strict=True)], axis=1
    )
    if scenario.noise:
        sigma = np.hypot(truth.velocity_std_m_s, truth.velocity_std_fraction * velocity)
        velocity = velocity + sigma * noise_rng.standard_normal(velocity.shape)
    velocity[lost_rng.uniform(size=velocity.shape) < truth.lost_fraction] = np.nan
    velocity[within(time, truth.no_lock_s)] = np.nan
    for item in truth.lost:
        velocity[within(time, [(item.from_s, item.to_s)]), item.beam - 1] = np.nan
    settings = cast("DvlBeamsSettings", scenario.settings("dvl_beams"))
    prefix = "beam_" if scenario.dvl is not None else ""
    calibration = {
        f"{prefix}lever_arm_m": np.array(truth.lever_arm_m),
        f"{prefix}averaging_s": np.array([truth.averaging_s]),
    }
    if settings.parametrisation == "beams":
        calibration |= {"beam_direction_b": directions, "beam_scale_error": scale}
    elif truth.direction_error_deg == () and np.ptp(scale) == 0.0:
        # Unequal beams have no common misalignment and scale that would be true.
        calibration[f"{prefix}misalignment_deg"] = np.array(truth.misalignment_deg)
        calibration[f"{prefix}scale_error"] = scale[:1]
    return DvlBeams(settings, time, velocity, prefix=prefix), calibration


def simulate_turntable(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[Turntable, dict[str, Array]]:
    """Return the record of the turntable, its angle without error."""
    truth: TurntableTruth = scenario.turntable
    assert motion.table is not None
    time = sample_times(truth, motion.duration, rng)
    angle = np.asarray(motion.table(time), dtype=float)
    return Turntable(cast("TurntableSettings", scenario.settings("turntable")), time, angle), {}


def _drawn(truth: DvlBeamsTruth, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the true directions in body (N, 3), and scale errors (N,)."""
    nominal_d = truth.nominal.nominal_d
    n = len(nominal_d)
    # Always drawn, so that a setting does not change the other draws.
    radius, bearing, part = rng.uniform(size=n), rng.uniform(size=n), rng.uniform(-1.0, 1.0, n)
    if truth.direction_error_deg == "draw":
        reach = (truth.direction_error_up_to_deg or 0.0) * np.sqrt(radius)
        angle = 2.0 * np.pi * bearing
        error = reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        error = np.array(truth.direction_error_deg, dtype=float).reshape(-1, 2)
        error = error if error.size else np.zeros((n, 2))
    if truth.scale_error == "draw":
        scale = (truth.scale_error_up_to or 0.0) * part
    else:
        scale = np.array(truth.scale_error) if truth.scale_error else np.zeros(n)
    to_body = Rotation.from_rotvec(np.array(truth.misalignment_deg) * DEG).inv()
    pairs = zip(to_body.apply(nominal_d), error, strict=True)
    return np.stack([_turned(d, by * DEG) for d, by in pairs]), scale


def _turned(nominal: Array, by: Array) -> Array:
    """Return a unit vector turned by two angles towards its two axes.

    The axes are the body's x and y, rotated by the shortest rotation from z (or -z, if nearer)
    to the vector.
    """
    pole = np.array([0.0, 0.0, -1.0 if nominal[2] < 0.0 else 1.0])
    across = np.cross(pole, nominal)
    sine = float(np.linalg.norm(across))
    unit = across / sine if sine > 0.0 else across
    shortest = Rotation.from_rotvec(np.arctan2(sine, pole @ nominal) * unit)
    towards = shortest.apply([by[0], by[1], 0.0])
    return np.asarray(Rotation.from_rotvec(np.cross(nominal, towards)).apply(nominal))
