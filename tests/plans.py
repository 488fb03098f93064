"""Plans for tests of the planner."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.planning import requirements

CALM = {"sway": {}, "current_m_s": [0.2, 0, 0]}

STRAIGHT = {"manoeuvres": [{"straight_s": 60}], "imu": {"rate_hz": 50}, **CALM}

WALKING = {"imu": {"gyro_noise_deg_sqrt_h": 0.1, "gyro_bias_walk_deg_h_sqrt_h": 1.0}}


def std_of(solution):
    return dict(zip(solution.order, np.sqrt(np.diag(solution.covariance)), strict=True))


def required_of(prediction, **required):
    values = {k: v if isinstance(v, tuple) else (v,) for k, v in required.items()}
    return requirements(values, prediction.solution.estimates, "plan.yaml")
