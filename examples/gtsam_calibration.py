"""Calibrate with GTSAM's own optimiser
=======================================

Take the graph of a trial, minimise it with GTSAM's Levenberg-Marquardt, and compare with
``solve``::

    python examples/gtsam_calibration.py
"""

import gtsam
import numpy as np

import factorgraph_dvl as fd

trial = fd.simulate("examples/short.yaml", seed=1)
solution = fd.solve(trial)

solved, *_ = fd.solved_problems(trial)
graph, start = solved.problem.nonlinear_graph()
parameters = gtsam.LevenbergMarquardtParams()
parameters.setLinearSolverType("MULTIFRONTAL_QR")  # Cholesky has too few digits for a good IMU
parameters.setRelativeErrorTol(1e-10)
found = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()

misalignment = gtsam.Rot3.Logmap(found.atRot3(solved.problem.key("misalignment_deg")))
for name, value in (
    ("misalignment_deg", np.degrees(misalignment)),
    ("scale_error", found.atVector(solved.problem.key("scale_error"))),
    ("lever_arm_m", found.atVector(solved.problem.key("lever_arm_m"))),
):
    estimate = solution.estimate(name)
    print(
        name, value, "differs by", np.abs(value - estimate.value).max() / estimate.std.min(), "σ"
    )
