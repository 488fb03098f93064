"""Calibrate a DVL from Python
==============================

Solve a trial, print the calibration, and correct the velocities of the DVL with it::

    python examples/calibrate.py [TRIAL]

Without an argument the script takes the shipped trial.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from factorgraph_dvl import load_trial, solve
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG

SHIPPED = Path(__file__).resolve().parent.parent / "data" / "seed-a-phase-90"


def main(path: Path) -> None:
    """Solve a trial, print the calibration, and correct the DVL's velocities with it."""
    trial = load_trial(path)
    solution = solve(trial)
    for estimate in solution.estimates:
        for name, value, std, observable in zip(
            estimate.component_names,
            estimate.value,
            estimate.std,
            estimate.observable,
            strict=True,
        ):
            remark = "" if observable else "  (not observable)"
            print(f"{name:>22} = {value:10.5f} ± {std:.5f}{remark}")
    print(f"verdict: {solution.verdict.grade}")
    for reason in solution.verdict.reasons:
        print(f"- {reason}. {reason.code.action}")

    if trial.dvl is not None:
        # C_b^d takes body components to DVL components; its transpose brings them back.
        dRb = exp_so3(solution.estimate("misalignment_deg").value * DEG)
        scale = 1.0 + solution.estimate("scale_error").value
        in_body = (trial.dvl.velocity / scale) @ dRb
        speed = np.nanmax(np.linalg.norm(in_body, axis=1))
        print(f"{in_body.shape[0]} pings in body axes, up to {speed:.2f} m/s")

    motion = solution.trajectory
    print(f"position to {1e3 * np.median(motion.position_std):.0f} mm in the median")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else SHIPPED)
