"""What all sensors share."""

from __future__ import annotations

from functools import partial

import numpy as np
from truth import scenario

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.records import rows_of as geometry_rows
from factorgraph_dvl.graph.observation_rows import ObservationRows
from factorgraph_dvl.graph.priors import prior_mean
from factorgraph_dvl.sensors.dvl import DvlVelocity
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.sensors.records import joined, rows_of
from factorgraph_dvl.simulation import simulate


def test_rows_of_a_record_are_joined_in_the_order_of_time():
    dvl = simulate(scenario()).dvl
    parts = [rows_of(dvl, [4]), rows_of(dvl, slice(0, 3)), rows_of(dvl, [1])]
    out = joined(parts)
    np.testing.assert_array_equal(out.time, dvl.time[[0, 1, 2, 4]])
    np.testing.assert_array_equal(out.velocity, dvl.velocity[[0, 1, 2, 4]])
    assert isinstance(out.observations(LocalFrame(0.0, 0.0, 0.0), "RFU")[0], DvlVelocity)


def test_some_measurements_are_evaluated_as_all_are():
    trial = simulate(scenario(noise=True))
    index = np.arange(3, 90, 2)
    for aid in (trial.gnss, trial.dvl):
        values = {p.name: prior_mean(p) for p in aid.parameters()}
        for whole in aid.observations(trial.frame(), "RFU"):
            count = whole.time.size
            motion = Motion(
                nRb=np.tile(np.eye(3), (count, 1, 1)),
                **{
                    name: np.random.default_rng(i).normal(size=(count, 3))
                    for i, name in enumerate(
                        ("p_n", "v_n", "omega_eb_b", "a_n", "alpha_b", "omega_sigma")
                    )
                },
            )
            some, rows = whole.some(index), ObservationRows(whole, index)
            own = geometry_rows(motion, index)
            np.testing.assert_array_equal(some.time, rows.time)
            near = partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-12)
            near(some.sigma(own, values), rows.sigma(own, values))
            one, other = (o.linearize(own, values, list(values)) for o in (some, rows))
            near(one.residual, other.residual)
            near(one.d_theta, other.d_theta)
            for name, by in other.d_parameters.items():
                near(np.broadcast_to(one.d_parameters[name], by.shape), by)
