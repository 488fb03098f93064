"""Prediction of the posterior of a planned trial."""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec
import numpy as np

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.graph.smooth_motion import SmoothStates
from factorgraph_dvl.sensors.attitude import LEAST_STD, Attitude, AttitudeAngles
from factorgraph_dvl.sensors.carried_point import PointPosition, PointVelocity
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.sensors.protocol import Observation
from factorgraph_dvl.sensors.records import white_noise
from factorgraph_dvl.simulation import plan_motion, simulate
from factorgraph_dvl.simulation.course import AngularSway, Heave, StartSettings
from factorgraph_dvl.simulation.motion import TrueMotion
from factorgraph_dvl.simulation.scenario import Scenario
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.solvers.information_along_trial import Frontier
from factorgraph_dvl.solvers.prediction import TrueStates, continue_posterior, predict_posterior
from factorgraph_dvl.statistics.information_history import InformationHistory
from factorgraph_dvl.trial import Trial

# Settings of the interruptions of sensors.
_INTERRUPTIONS = ("gaps_s", "outages_s", "no_lock_s", "lost")


@dataclass(frozen=True)
class Ending:
    """End of a motion, from which further manoeuvres continue.

    Parameters
    ----------
    start : StartSettings
        Position, heading and speed at the end.
    time : float
        Time since the start of the plan, s, for the phase of the sway.
    frontier : Frontier or None
        Posterior at the end; None without IMU, where the whole plan is predicted anew: errors of
        compass and GNSS last longer than a manoeuvre.
    """

    start: StartSettings
    time: float
    frontier: Frontier | None


@dataclass(frozen=True)
class Prediction:
    """Predicted posterior of a planned trial.

    Parameters
    ----------
    scenario, trial : Scenario or Trial
        The plan, and its records without noise.
    solution : Solution
        Solution with true values and predicted covariances.
    history : InformationHistory
        Information along the trial.
    duration : float
        Duration, s.
    ending : Ending
        End of the motion.
    """

    scenario: Scenario
    trial: Trial
    solution: Solution
    history: InformationHistory
    duration: float
    ending: Ending


def predict(scenario: Scenario) -> Prediction:
    """Predict the posterior of a scenario, without noise and without solving.

    Raises
    ------
    ConfigError
        If the manoeuvres cannot be carried out, or the scenario is planar.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> prediction = fd.predict(fd.load_scenario("examples/short.yaml"))
    >>> prediction.solution.estimate("misalignment_deg").std.round(2)
    array([0.03, 0.06, 0.02])
    """
    if scenario.planar:
        raise ConfigError(
            "no prediction is made of a planar trial",
            where=scenario.source,
            expected="imu, attitude or ins in place of heading and log",
        )
    scenario = msgspec.structs.replace(scenario, noise=False)
    motion = plan_motion(scenario)
    trial = simulate(scenario)
    white: dict[str, Array] = {}
    if trial.imu is None:
        white = _white_noise(simulate(msgspec.structs.replace(scenario, noise=True)), trial)
    solution, history, frontier = predict_posterior(trial, _true_states(motion), white)
    return Prediction(
        scenario=scenario,
        trial=trial,
        solution=replace(solution, solver="plan"),
        history=history,
        duration=motion.duration,
        ending=_ending(motion, None if trial.imu is None else frontier, 0.0),
    )


def extend(
    scenario: Scenario, manoeuvres: list[dict[str, object]], ending: Ending
) -> tuple[InformationHistory, Ending]:
    """Predict the posterior after further manoeuvres.

    Parameters
    ----------
    scenario : Scenario
        Scenario of the plan, with its sway and sensors, an IMU among them.
    manoeuvres : list of dict of str to object
        Manoeuvres to add, as in a scenario.
    ending : Ending
        End of the motion so far.

    Returns
    -------
    history : InformationHistory
        Information along the added part.
    ending : Ending
        End of the added part.
    """
    sway = scenario.sway
    shifted = msgspec.structs.replace(
        sway,
        **{
            name: tuple(_later(part, ending.time) for part in getattr(sway, name))
            for name in ("roll", "pitch", "yaw", "heave")
        },
    )
    # Interruptions and turns of the turntable belong to the time before.
    sensors = {
        name: msgspec.structs.replace(
            truth, **{f: () for f in _INTERRUPTIONS if hasattr(truth, f)}
        )
        for name, truth in {"imu": scenario.imu, **scenario.aids}.items()
        if truth is not None
    }
    if scenario.turntable is not None:
        turned = scenario.turntable.start_deg + sum(t.turn_deg for t in scenario.turntable.turns)
        stopped = msgspec.structs.replace(scenario.turntable, turns=(), start_deg=turned)
        sensors["turntable"] = stopped
    further = msgspec.structs.replace(
        scenario, start=ending.start, manoeuvres=manoeuvres, sway=shifted, **sensors
    )
    motion = plan_motion(further)
    trial = simulate(further)
    start = ending.frontier
    assert start is not None
    history, frontier = continue_posterior(trial, _true_states(motion), start)
    return history, _ending(motion, frontier, ending.time)


def _later(part: AngularSway | Heave, time: float) -> AngularSway | Heave:
    phase = part.phase_deg + 360.0 * part.frequency_hz * time
    return msgspec.structs.replace(part, phase_deg=phase % 360.0)


def _ending(motion: TrueMotion, frontier: Frontier | None, before: float) -> Ending:
    end = np.array([motion.duration])
    state = motion.at(end)
    # The mean motion, to which sway is added again.
    start = StartSettings(
        lat_deg=float(state.geodetic[0, 0] / DEG),
        lon_deg=float(state.geodetic[0, 1] / DEG),
        height_m=float(motion.height(end)[0]) + float(motion.current_n[2]) * motion.duration,
        heading_deg=float(motion.course(end)[0] / DEG) % 360.0,
        speed_m_s=max(float(motion.speed(end)[0]), 0.0),
    )
    return Ending(start, before + motion.duration, frontier)


def _true_states(motion: TrueMotion) -> TrueStates:
    def states(frame: LocalFrame, time: Array) -> SmoothStates:
        inside = np.clip(time, 0.0, motion.duration)
        state = motion.at(inside)
        lRn = frame.level_from_tangent(state.geodetic[:, 0], state.geodetic[:, 1])
        nRl = lRn.transpose(0, 2, 1)
        v_n, beyond = rotate(nRl, state.v_n), (time - inside)[:, None]
        # A node may be a little before the start or after the end.
        return SmoothStates(
            nRb=nRl
            @ rotation_from_rph(state.rph, motion.body_axes)
            @ exp_so3(beyond * state.omega_eb_b),
            p_n=frame.position(*state.geodetic.T) + beyond * v_n,
            v_n=v_n,
            omega_b=state.omega_eb_b,
        )

    return states


def _white_noise(recorded: Trial, exact: Trial) -> dict[str, Array]:
    """Return the white noise of attitude and INS, by label: no trial states it, a record shows it.

    Parameters
    ----------
    recorded, exact : Trial
        Trials with noise and without.
    """
    frame, axes = exact.frame(), exact.body_axes
    out = {}
    for noisy, aid in zip(recorded.aids, exact.aids, strict=True):
        if not (isinstance(noisy, Attitude | Ins) and isinstance(aid, Attitude | Ins)):
            continue
        if not recorded.estimates_noise(noisy):
            continue
        both = (each.dense_observations(frame, axes) for each in (noisy, aid))
        for one, other in zip(*both, strict=True):
            error = np.unwrap(_measured(one) - _measured(other), axis=0)
            in_group = [i for group in one.noise_groups for i in group]
            own = np.maximum(white_noise(error), LEAST_STD)
            estimated = np.isin(np.arange(own.size), in_group)
            out[one.label] = np.where(estimated, own, np.nan)
    return out


def _measured(o: Observation) -> Array:
    """Return what an attitude sensor or an INS measured, (M, 3), SI."""
    if isinstance(o, PointPosition):
        return o.measured_n
    if isinstance(o, PointVelocity):
        return o.measured_l
    assert isinstance(o, AttitudeAngles)
    return o.measured
