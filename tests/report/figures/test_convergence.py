"""The figure of a calibration over time."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.report.figures.convergence import convergence_figure


def test_the_figure_has_every_beam_also_one_that_came_late():
    n = 8
    beams = Estimate(
        "beam_scale_error",
        tuple(f"beam_scale_error_{i + 1}" for i in range(n)),
        *(np.full(n, x) for x in (0.001, 1e-4, 0.0, 0.1)),
        np.full(n, True),
    )
    time = np.arange(20.0)
    values = np.where(time[:, None] < 10.0, np.nan, np.full((20, n), 0.001))
    figure = convergence_figure(time, values, 0.1 * values, [beams], {}, np.nan)
    assert [ax.get_title(loc="left") for ax in figure.axes] == [
        f"beam scale error {i + 1}" for i in range(n)
    ]
    assert all(ax.get_ylim()[1] < 0.002 for ax in figure.axes)
