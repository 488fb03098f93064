"""What windows take from a batch solution."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from truth import CONFIGS

from factorgraph_dvl.imu.attitude_record import AttitudeRecord
from factorgraph_dvl.replay.window import BatchSolution
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import load_scenario, simulate
from factorgraph_dvl.solvers.preparation_without_imu import prepare_without_imu
from factorgraph_dvl.solvers.rounds import settle

LEGS = [{"straight_s": 40}, {"turn_deg_s": 3, "duration_s": 40, "ramp_s": 5}]


@pytest.fixture(scope="module")
def ship():
    scenario = msgspec.structs.replace(load_scenario(CONFIGS / "ship.yaml"), manoeuvres=LEGS)
    return simulate(scenario, 2)


def solved(trial, duration):
    prepared = prepare_without_imu(trial)
    settled = settle(prepared, prepared.states, lambda stage, iteration, cost: None)
    return settled.problem, BatchSolution.of(prepared, settled.problem, duration)


@pytest.fixture(scope="module")
def found(ship):
    return solved(ship, 80.0)


def test_a_few_rows_have_the_noise_of_the_record(ship, found):
    problem, batch = found
    rows = rows_of(ship.attitude, slice(100, 110))
    (few,) = batch.observations(rows)
    (every,) = (o for o in problem.observations if o.label == "Attitude")
    np.testing.assert_allclose(few.std, every.std[100:110])
    # Stated noise of other sensors may differ from row to row.
    assert batch.std.keys() == {"Attitude"}
    assert batch.labels["gnss"] == {"GNSS position"}


def test_densities_are_those_of_turns_where_the_vessel_turns(ship, found):
    _, batch = found
    record = AttitudeRecord(ship.attitude, ship.body_axes, estimated=False)
    density = batch.density(record, np.array([20.0, 43.0, 65.0]))
    # The averages that axes of the track follow reach over the whole of this turn.
    np.testing.assert_array_equal(density, batch.densities[[0, 2, 2]])
    assert np.any(batch.densities[0] != batch.densities[2])


def test_before_the_first_turn_another_strength_is_assumed(ship):
    _, batch = solved(ship.until(35.0), 35.0)
    leg, *others = batch.densities
    for density in others:
        np.testing.assert_array_equal(density[:3], leg[:3])
        assert np.all(density[3:] >= 1e-3)


def test_the_tilt_grows_with_time(found):
    problem, batch = found
    np.testing.assert_allclose(80.0 * batch.tilt, problem.tilt.gradient)
