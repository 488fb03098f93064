"""States eliminated range by range, against all of them at once."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import msgspec
import numpy as np
import pytest
from truth import TURNS_AND_BRAKING, config, merged, scenario

from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.sensors.imu import ERRORS
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers import state_ranges
from factorgraph_dvl.solvers.batch import solved_problems
from factorgraph_dvl.solvers.known_parameters import wide, with_scattered_noise
from factorgraph_dvl.solvers.levenberg_marquardt import factorized
from factorgraph_dvl.solvers.preparation_without_imu import prepare_without_imu
from factorgraph_dvl.solvers.state_ranges import eliminated_by_ranges
from factorgraph_dvl.statistics.constancy import by_interval
from factorgraph_dvl.statistics.rows import rows_by_source, rows_with_times
from factorgraph_dvl.statistics.scores import scores

SCENE = {
    "noise": True,
    "manoeuvres": TURNS_AND_BRAKING,
    "imu": {"rate_hz": 50, "gyro_noise_deg_sqrt_h": 0.005},
    "gnss": {
        "position_std_m": [0.1, 0.1, 0.2],
        "velocity_std_m_s": [0.03] * 3,
    },
    "dvl": {"velocity_std_fraction": 0.001},
    "trial": {
        "gnss": {"lever_arm_std_m": [0.0] * 3, "time_offset_std_s": 0.0},
        "dvl": {"velocity_std_fraction": 0.001, "time_offset_std_s": 0.0},
    },
}


@pytest.fixture(scope="module", params=[False, True], ids=["constant", "walking"])
def solved(request):
    """Return a problem at its minimum, and the same parameters, those it knows being free."""
    trial = simulate(scenario(**merged({}, SCENE)), 4)
    if request.param:
        walk = {"gyro_bias_walk_deg_h_sqrt_h": 0.1, "accel_bias_walk_ug_sqrt_h": 20.0}
        settings = msgspec.structs.replace(trial.imu.settings, **walk)
        trial = replace(trial, imu=replace(trial.imu, settings=settings))
    # A gap, in which a range ends somewhere.
    silent = (trial.imu.time > 40.0) & (trial.imu.time < 43.0)
    trial = replace(trial, imu=rows_of(trial.imu, ~silent))
    found, *_ = solved_problems(trial)
    known = {
        p.name
        for p in found.problem.all_parameters
        if not (p.estimated or p.spec.usual) and p.spec.plausible is not None
    }
    assert known > {*ERRORS}
    free = [wide(p, p.mean) if p.name in known else p for p in found.problem.all_parameters]
    return found.problem, found.minimum.evaluation, known, free


@pytest.mark.parametrize("longest", [7, 1000])
def test_ranges_have_the_information_of_the_whole(solved, monkeypatch, longest):
    problem, evaluation, known, free = solved
    part = partial(with_scattered_noise, problem, evaluation, free)
    test, at = part(None)
    columns = {p.name: (test.key(p.name), p.sigma) for p in free if p.name in known}
    information, delta = factorized(test, at)
    expected = scores(delta, information, columns)
    monkeypatch.setattr(state_ranges, "_LONGEST", longest)
    ranges = eliminated_by_ranges(part, problem.chain)
    assert len(ranges.blocks) == -(-problem.chain.segments.first.size // longest)
    assert {name: ranges.names[name] for name in columns} == {
        name: key for name, (key, _) in columns.items()
    }
    found = scores(ranges.information.solution(), ranges.information, columns)
    for name in known:
        one, other = found.test([name]), expected.test([name])
        assert one.chi2 == pytest.approx(other.chi2, rel=1e-6, abs=1e-6)
        np.testing.assert_allclose(one.std, other.std, rtol=1e-6)
        np.testing.assert_allclose(one.step / other.std, other.step / other.std, atol=1e-6)
    # What the rows of the ranges say of parts of the trial is what those of the whole say.
    scaled = [{key: np.diag(1.0 / sigma)} for key, sigma in columns.values()]
    time = problem.chain.segments.node_time
    edges = np.linspace(time[0], time[-1], 6)[1:-1]
    gain = np.linalg.inv(information.covariance_of(scaled))
    following = {key: P @ gain for key, P in information.covariance_with(scaled).items()}
    whole = by_interval(rows_with_times(test, rows_by_source(test, at)), following, edges)
    shared = ranges.information.covariance_with(scaled)
    parts = [
        by_interval(rows, own, edges)
        for rows, own in ranges.rows({key: P @ gain for key, P in shared.items()})
    ]
    for one, other in zip(zip(*parts, strict=True), whole, strict=True):
        np.testing.assert_allclose(sum(one), other, rtol=1e-5, atol=1e-7 * np.abs(other).max())


def test_ranges_of_a_chain_without_imu_have_the_information_of_the_whole(monkeypatch):
    lines = [{"straight_s": 40}, {"turn_deg_s": 3, "duration_s": 30}, {"straight_s": 20}]
    prepared = prepare_without_imu(simulate(config("ship", manoeuvres=lines), 1))
    chain, values = prepared.chain(prepared.states), prepared.values
    problem = Problem(chain, prepared.observations, prepared.parameters, start=values)
    at = problem.values(prepared.states, problem.prior_values() | values)
    evaluation = problem.weighed(problem.evaluate(at))
    part = partial(with_scattered_noise, problem, evaluation, problem.all_parameters)
    whole = eliminated_by_ranges(part, chain)
    monkeypatch.setattr(state_ranges, "_LONGEST", 20)
    ranges = eliminated_by_ranges(part, chain)
    assert len(ranges.blocks) > 3
    size = len(problem.prior_root)
    every = {key: np.eye(size)[:, problem.columns[name]] for name, key in ranges.names.items()}
    found, expected = (each.information.covariance_of([every]) for each in (ranges, whole))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
