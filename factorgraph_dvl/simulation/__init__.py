"""Simulated trials: a scenario and a seed become a trial with its truth.

The motion is analytic in the local-level frame (`motion`), and the measurements come from
equations of their own (`measurements`): nothing here is shared with the estimator but the
conventions and the Earth model, so that an error in one does not cancel in the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from typing import Any, cast

import numpy as np

from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.simulation.catalogue import INSTRUMENTS, PLANAR_INSTRUMENTS, Instrument
from factorgraph_dvl.simulation.measurements import displaced
from factorgraph_dvl.simulation.motion import TrueMotion, plan_motion
from factorgraph_dvl.simulation.scenario import Scenario, load_scenario, parse_scenario
from factorgraph_dvl.simulation.stated_errors import with_stated_errors
from factorgraph_dvl.trial import (
    InitialAttitude,
    InitialPosition,
    InitialVelocity,
    Reference,
    Trial,
)

__all__ = [
    "Scenario",
    "load_scenario",
    "parse_scenario",
    "plan_motion",
    "simulate",
]


def simulate(scenario: Scenario | str | PathLike[str], seed: int = 0) -> Trial:
    """Simulate a trial, with its reference and its true calibration.

    Parameters
    ----------
    scenario : Scenario or path-like of str
        A scenario, or the path of its YAML file.
    seed : int, default 0
        Random seed. Each sensor has a random stream of its own, and so has each of its errors but
        white noise, bias and beams: adding or changing one does not change the others.

    Raises
    ------
    ConfigError
        If the scenario cannot be read, or is not valid.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> trial = fd.simulate("examples/short.yaml", seed=1)
    >>> trial.calibration_truth["lever_arm_m"]
    array([ 0.8,  1.2, -1. ])
    """
    if not isinstance(scenario, Scenario):
        scenario = load_scenario(scenario)
    motion = plan_motion(scenario)
    instruments = PLANAR_INSTRUMENTS if scenario.planar else INSTRUMENTS
    aids, truth = _records(instruments, scenario, motion, seed)
    imu = cast("Imu | None", aids.pop("imu", None))
    start = np.zeros(1) if imu is None else imu.time[:1]
    if scenario.planar:
        start = np.array([max(aids[name].time[0] for name in ("heading", "log", "depth"))])
        # In the plane the height of the sea surface is as stated.
        truth.pop("sea_surface_height_m")
    attitude, position, velocity = _initial(scenario, motion, start)
    trial = Trial(
        name=scenario.name,
        imu=imu,
        gnss=cast("Gnss | None", aids.pop("gnss", None)),
        dvl=cast("Dvl | None", aids.pop("dvl", None)),
        others=tuple(aids.values()),
        body_axes=scenario.body_axes,
        epoch=scenario.epoch,
        noise=scenario.trial.noise,
        initial_attitude=attitude,
        initial_position=position,
        initial_velocity=velocity,
        reference=_reference(motion, scenario.reference_rate_hz),
        calibration_truth=truth,
    )
    return with_stated_errors(trial, scenario, seed)


def _records(
    instruments: Mapping[str, Instrument], scenario: Scenario, motion: TrueMotion, seed: int
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return the records of a scenario's instruments by section, and their calibration."""
    records: dict[str, Any] = {}
    truth: dict[str, Array] = {}
    rngs = np.random.default_rng(seed).spawn(len(instruments))
    for (section, instrument), rng in zip(instruments.items(), rngs, strict=True):
        if getattr(scenario, section) is not None:
            records[section], calibration = instrument.simulate(scenario, motion, rng)
            truth |= calibration
    return records, truth


def _initial(
    scenario: Scenario, motion: TrueMotion, time: Array
) -> tuple[InitialAttitude | None, InitialPosition | None, InitialVelocity | None]:
    claim = scenario.trial.initial
    if claim is None:
        return None, None, None
    state = motion.at(time)
    attitude = position = velocity = None
    if claim.attitude_std_deg is not None:
        rph = state.rph[0] + np.array(claim.attitude_error_deg) * DEG
        attitude = InitialAttitude(rph=rph, std=np.array(claim.attitude_std_deg) * DEG)
    if claim.position_std_m is not None:
        geodetic = displaced(state.geodetic, np.array([claim.position_error_m]))[0]
        position = InitialPosition(geodetic=geodetic, std=np.array(claim.position_std_m))
    if claim.velocity_std_m_s is not None:
        known = state.v_n[0] + np.array(claim.velocity_error_m_s)
        velocity = InitialVelocity(velocity=known, std=np.array(claim.velocity_std_m_s))
    return attitude, position, velocity


def _reference(motion: TrueMotion, rate: float) -> Reference:
    # Divided by the rate, not multiplied by the period, so that times have few digits.
    time = np.arange(int(np.floor(motion.duration * rate + 1e-6)) + 1) / rate
    state = motion.at(time)
    rph = state.rph.copy()
    rph[:, 2] %= 2.0 * np.pi
    return Reference(time=time, geodetic=state.geodetic, velocity=state.v_n, rph=rph)
