"""Factor-graph calibration of Doppler velocity logs, jointly with the trajectory.

Conventions
-----------
Frames: `i` inertial, `e` ECEF, `n` navigation (inside the graph a tangent east-north-up
frame at the trial's origin; local-level east-north-up in files), `b` body of the IMU,
`d` DVL, `a` GNSS antenna. Rotations: `nRb` takes b to n. Vectors carry the frame that
they are resolved in: `v_n`, `omega_eb_b`. Lever arms run from the IMU to the sensor, in
b. Residual = predicted - measured. SI units and radians; other units stand in names.

The DVL reports v_d = (1 + k) dRb (v_b + omega_eb_b x l) + beta, at its true time.

Public names
------------
Trials: `Trial`, `trial_from_tables`, `load_trial`, `save_trial`, `simulate`, and the records
`Imu`, `Gnss`, `Dvl` with their settings. `survey` says what a trial contains, and what is wrong.

Estimates: `solve`, `Replay`, `kalman` (the usual filters, to compare). They return a `Solution`,
with its `Trajectory`, each `Estimate` and a `Verdict`; `load_solution`, `save_solution`,
`load_calibration`; `plot`, `to_dataframe`, `to_xarray`.

Analyses: `crosscheck`, `observability`, `predict` (of a scenario from `load_scenario`),
`dead_reckon` (with `mounting_of` and an `AttitudeHistory`), and of many trials
`joint_calibration` (with `information_of` each `TrialCalibration`).

Parts for a GTSAM script of one's own: `preintegrate`, `measured_nodes`, `sensor_factor`,
`solved_problems` (whose `Problem.nonlinear_graph` is the whole problem), `LocalFrame`. For a
sensor of one's own: `check_sensor`.

Errors: `ConfigError`, `DataError` and `SolveError` are each a `FactorgraphDvlError`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from factorgraph_dvl.analysis.comparison.crosscheck import crosscheck
    from factorgraph_dvl.analysis.dead_reckoning.integration import dead_reckon, mounting_of
    from factorgraph_dvl.analysis.information.observability import observability
    from factorgraph_dvl.baselines.calibration import kalman
    from factorgraph_dvl.campaign.information import TrialCalibration, information_of
    from factorgraph_dvl.campaign.joint_calibration import joint_calibration
    from factorgraph_dvl.errors import (
        ConfigError,
        DataError,
        FactorgraphDvlError,
        SolveError,
    )
    from factorgraph_dvl.estimates import Estimate, Trajectory
    from factorgraph_dvl.files.calibration_file import load_calibration
    from factorgraph_dvl.files.data_frames import to_dataframe, to_xarray
    from factorgraph_dvl.files.solution_folder import load_solution, save_solution
    from factorgraph_dvl.files.trial_folder import load_trial, save_trial
    from factorgraph_dvl.files.trial_tables import trial_from_tables
    from factorgraph_dvl.geometry.earth import LocalFrame
    from factorgraph_dvl.graph.problem import Problem
    from factorgraph_dvl.graph.sensor_check import check_sensor
    from factorgraph_dvl.graph.sensor_factor import measured_nodes, sensor_factor
    from factorgraph_dvl.imu.attitude_history import AttitudeHistory
    from factorgraph_dvl.imu.gtsam_measurements import preintegrate
    from factorgraph_dvl.planning.prediction import predict
    from factorgraph_dvl.plausibility.survey import survey
    from factorgraph_dvl.quality.verdict import Verdict
    from factorgraph_dvl.replay.session import Replay
    from factorgraph_dvl.report.figures.solution import plot
    from factorgraph_dvl.sensors.dvl import Dvl, DvlSettings
    from factorgraph_dvl.sensors.gnss import Gnss, GnssSettings
    from factorgraph_dvl.sensors.imu import Imu, ImuSettings
    from factorgraph_dvl.simulation import simulate
    from factorgraph_dvl.simulation.scenario import load_scenario
    from factorgraph_dvl.solution import Calibration, Solution
    from factorgraph_dvl.solvers.batch import solve, solved_problems
    from factorgraph_dvl.trial import Trial

    __version__: str

# Module of each public name.
_PUBLIC = {
    "AttitudeHistory": "imu.attitude_history",
    "Calibration": "solution",
    "ConfigError": "errors",
    "DataError": "errors",
    "Dvl": "sensors.dvl",
    "DvlSettings": "sensors.dvl",
    "Estimate": "estimates",
    "FactorgraphDvlError": "errors",
    "Gnss": "sensors.gnss",
    "GnssSettings": "sensors.gnss",
    "Imu": "sensors.imu",
    "ImuSettings": "sensors.imu",
    "LocalFrame": "geometry.earth",
    "Problem": "graph.problem",
    "Replay": "replay.session",
    "Solution": "solution",
    "SolveError": "errors",
    "Trajectory": "estimates",
    "Trial": "trial",
    "TrialCalibration": "campaign.information",
    "Verdict": "quality.verdict",
    "check_sensor": "graph.sensor_check",
    "crosscheck": "analysis.comparison.crosscheck",
    "dead_reckon": "analysis.dead_reckoning.integration",
    "information_of": "campaign.information",
    "joint_calibration": "campaign.joint_calibration",
    "kalman": "baselines.calibration",
    "load_calibration": "files.calibration_file",
    "load_scenario": "simulation.scenario",
    "load_solution": "files.solution_folder",
    "load_trial": "files.trial_folder",
    "measured_nodes": "graph.sensor_factor",
    "mounting_of": "analysis.dead_reckoning.integration",
    "observability": "analysis.information.observability",
    "plot": "report.figures.solution",
    "predict": "planning.prediction",
    "preintegrate": "imu.gtsam_measurements",
    "save_solution": "files.solution_folder",
    "save_trial": "files.trial_folder",
    "sensor_factor": "graph.sensor_factor",
    "simulate": "simulation",
    "solve": "solvers.batch",
    "solved_problems": "solvers.batch",
    "survey": "plausibility.survey",
    "to_dataframe": "files.data_frames",
    "to_xarray": "files.data_frames",
    "trial_from_tables": "files.trial_tables",
}

__all__ = [
    "AttitudeHistory",
    "Calibration",
    "ConfigError",
    "DataError",
    "Dvl",
    "DvlSettings",
    "Estimate",
    "FactorgraphDvlError",
    "Gnss",
    "GnssSettings",
    "Imu",
    "ImuSettings",
    "LocalFrame",
    "Problem",
    "Replay",
    "Solution",
    "SolveError",
    "Trajectory",
    "Trial",
    "TrialCalibration",
    "Verdict",
    "check_sensor",
    "crosscheck",
    "dead_reckon",
    "information_of",
    "joint_calibration",
    "kalman",
    "load_calibration",
    "load_scenario",
    "load_solution",
    "load_trial",
    "measured_nodes",
    "mounting_of",
    "observability",
    "plot",
    "predict",
    "preintegrate",
    "save_solution",
    "save_trial",
    "sensor_factor",
    "simulate",
    "solve",
    "solved_problems",
    "survey",
    "to_dataframe",
    "to_xarray",
    "trial_from_tables",
]


def __getattr__(name: str) -> Any:
    from importlib import import_module

    # GTSAM and SciPy take most of a second to load: only where they are used.
    if name == "__version__":
        from importlib.metadata import version

        return version("factorgraph-dvl")
    if name in _PUBLIC:
        return getattr(import_module(f"{__name__}.{_PUBLIC[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__all__", "__doc__", "__file__", "__name__", "__path__", "__version__"]
