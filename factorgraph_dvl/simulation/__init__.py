"""Simulated trials: a scenario and a seed become a trial with its truth.

The motion is analytic in the local-level frame (`motion`), and the measurements come from
equations of their own (`measurements`): nothing here is shared with the estimator but the
conventions and the Earth model, so that an error in one does not cancel in the other.
"""

from __future__ import annotations

from os import PathLike

import numpy as np

from factorgraph_dvl.conventions import DEG, Array
from factorgraph_dvl.simulation.measurements import displaced, simulate_dvl, simulate_gnss
from factorgraph_dvl.simulation.measurements import simulate_imu as _simulate_imu
from factorgraph_dvl.simulation.motion import Motion, plan_motion
from factorgraph_dvl.simulation.scenario import Scenario, load_scenario, parse_scenario
from factorgraph_dvl.trial import InitialAttitude, InitialPosition, Reference, Trial

__all__ = ["Scenario", "load_scenario", "parse_scenario", "plan_motion", "simulate"]


def simulate(scenario: Scenario | str | PathLike[str], seed: int = 0) -> Trial:
    """Simulate a trial, with its reference and its true calibration.

    Parameters
    ----------
    scenario : a scenario, or the path of its YAML file.
    seed : of all that is random. Each sensor draws from a stream of its own, so that
        adding or changing one leaves the others as they were.

    Raises
    ------
    ConfigError
        If the scenario cannot be read or is not valid.
    """
    if not isinstance(scenario, Scenario):
        scenario = load_scenario(scenario)
    imu_rng, gnss_rng, dvl_rng = np.random.default_rng(seed).spawn(3)
    motion = plan_motion(scenario)
    imu, truth = _simulate_imu(scenario, motion, imu_rng)
    gnss = dvl = None
    if scenario.gnss is not None:
        gnss = simulate_gnss(scenario, motion, gnss_rng)
        truth["gnss_lever_arm_m"] = np.array(scenario.gnss.lever_arm_m)
    if scenario.dvl is not None:
        dvl = simulate_dvl(scenario, motion, dvl_rng)
        truth["misalignment_deg"] = np.array(scenario.dvl.misalignment_deg)
        truth["scale_error"] = np.atleast_1d(np.array(scenario.dvl.scale_error, dtype=float))
        truth["lever_arm_m"] = np.array(scenario.dvl.lever_arm_m)
        truth["dvl_bias_m_s"] = np.array(scenario.dvl.bias_m_s)
        truth["time_offset_s"] = np.array([scenario.dvl.time_offset_s])
        if dvl.settings.reference == "water":
            truth["current_m_s"] = np.array(scenario.current_m_s[:2])
    attitude, position = _initial(scenario, motion, imu.time[:1])
    return Trial(
        name=scenario.name,
        imu=imu,
        gnss=gnss,
        dvl=dvl,
        body_axes=scenario.body_axes,
        initial_attitude=attitude,
        initial_position=position,
        reference=_reference(motion, scenario.reference_rate_hz),
        calibration_truth=truth,
    )


def _initial(
    scenario: Scenario, motion: Motion, time: Array
) -> tuple[InitialAttitude | None, InitialPosition | None]:
    claim = scenario.trial.initial
    if claim is None:
        return None, None
    state = motion.at(time)
    attitude = position = None
    if claim.attitude_std_deg is not None:
        rph = state.rph[0] + np.array(claim.attitude_error_deg) * DEG
        attitude = InitialAttitude(rph=rph, std=np.array(claim.attitude_std_deg) * DEG)
    if claim.position_std_m is not None:
        geodetic = displaced(state.geodetic, np.array([claim.position_error_m]))[0]
        position = InitialPosition(geodetic=geodetic, std=np.array(claim.position_std_m))
    return attitude, position


def _reference(motion: Motion, rate: float) -> Reference:
    # Divided, not multiplied by a period: then a time that a file can hold in few digits
    # is that number.
    time = np.arange(int(np.floor(motion.duration * rate + 1e-6)) + 1) / rate
    state = motion.at(time)
    rph = state.rph.copy()
    rph[:, 2] %= 2.0 * np.pi
    return Reference(time=time, geodetic=state.geodetic, velocity=state.v_n, rph=rph)
