"""Factor-graph calibration of Doppler velocity logs, jointly with the trajectory.

Conventions
-----------
Frames: `i` inertial, `e` ECEF, `n` navigation (inside the graph a tangent east-north-up
frame at the trial's origin; local-level east-north-up in files), `b` body of the IMU,
`d` DVL, `a` GNSS antenna. Rotations: `nRb` takes b to n. Vectors carry the frame that
they are resolved in: `v_n`, `omega_eb_b`. Lever arms run from the IMU to the sensor, in
b. Residual = predicted - measured. SI units and radians; other units stand in names.

The DVL reports v_d = (1 + k) dRb (v_b + omega_eb_b x l) + beta, at its true time.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from factorgraph_dvl.io.solution_folder import load_solution, save_solution
    from factorgraph_dvl.io.trial_folder import load_trial, save_trial
    from factorgraph_dvl.replay.session import Replay
    from factorgraph_dvl.simulation import simulate
    from factorgraph_dvl.solution import Solution
    from factorgraph_dvl.solvers.batch import solve
    from factorgraph_dvl.trial import Trial

    __version__: str

_PUBLIC = {
    "Replay": "factorgraph_dvl.replay.session",
    "Solution": "factorgraph_dvl.solution",
    "Trial": "factorgraph_dvl.trial",
    "load_solution": "factorgraph_dvl.io.solution_folder",
    "load_trial": "factorgraph_dvl.io.trial_folder",
    "save_solution": "factorgraph_dvl.io.solution_folder",
    "save_trial": "factorgraph_dvl.io.trial_folder",
    "simulate": "factorgraph_dvl.simulation",
    "solve": "factorgraph_dvl.solvers.batch",
}

__all__ = [
    "Replay",
    "Solution",
    "Trial",
    "load_solution",
    "load_trial",
    "save_solution",
    "save_trial",
    "simulate",
    "solve",
]


def __getattr__(name: str) -> Any:
    # GTSAM and SciPy take most of a second to load: only where they are used.
    if name == "__version__":
        from importlib.metadata import version

        return version("factorgraph-dvl")
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
