"""When a calibration was good enough."""

from __future__ import annotations

import numpy as np
import pytest
from truth import scenario

from factorgraph_dvl.analysis.convergence import check_limits, convergence, short_of_limits
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.simulation import simulate


def test_convergence_is_the_last_time_that_a_limit_is_crossed():
    time = np.arange(5.0)
    one = Estimate(
        "scale_error",
        ("scale_error",),
        *(np.array([x]) for x in (0.01, 1e-4, 0.0, 0.1)),
        np.array([True]),
    )
    values = np.array([[0.5], [0.011], [0.02], [0.0101], [0.0102]])
    std = np.array([[1.0], [1e-4], [1e-4], [1e-4], [1e-4]])
    inconsistent = np.array([False, False, True, False, False])
    limits = {"scale_error": 1e-3}
    truth = {"scale_error": [0.01]}
    found = convergence(time, values, std, inconsistent, [one], truth, limits, limits)
    (c,) = found.components
    assert (c.std_since, c.error_since, found.good_since) == (1.0, 3.0, 3.0)
    never = convergence(time, values, std + 1.0, inconsistent, [one], {}, limits, limits)
    assert np.isnan(never.good_since)
    assert np.isnan(never.components[0].error_since)
    assert short_of_limits([one], {"scale_error": 1e-5}) == ("scale_error",)
    assert short_of_limits([one], limits) == ()
    with pytest.raises(ConfigError, match=r"'speed'.*misalignment_deg, scale_error, lever_arm_m"):
        check_limits(simulate(scenario()), ["scale_error", "speed"])
