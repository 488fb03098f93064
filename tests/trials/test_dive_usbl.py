"""Half an hour of box under a ship with a USBL: whether the calibration is as good as it says.

    pytest -m slow tests/trials/test_dive_usbl.py

FACTORGRAPH_DVL_SEEDS sets the number of dives, 3 by default.
"""

from __future__ import annotations

import os
from dataclasses import replace
from itertools import chain

import msgspec
import numpy as np
import pytest
from truth import config

from factorgraph_dvl import predict
from factorgraph_dvl.analysis.error_statistics import nees_band
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.sensors.usbl import Usbl
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.solvers.preparation import prepare
from factorgraph_dvl.solvers.preparation_without_imu import prepare_without_imu

SEEDS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "3"))
DVL = ("misalignment_deg", "scale_error", "lever_arm_m")
USBL = (("usbl_misalignment_deg",), ("usbl_sound_speed_error",))
WITHOUT_IMU = {
    "imu": None,
    "attitude": {"rate_hz": 5, "std_deg": [0.2, 0.2, 0.2], "correlation_time_s": 300.0},
    "trial": {"imu": None},
}
NET = tuple(f"beacon_T{i}_offset_m" for i in (1, 2, 3))


def nees(solution, truth, names):
    """Return the squared error of parameters, normalised by their covariance, and their number."""
    order = solution.calibration.order
    columns, error = [], []
    for e in solution.calibration.estimates:
        if e.name in names:
            columns += [order.index(name) for name in e.component_names]
            error += list(np.atleast_1d(e.value) - truth[e.name])
    P = solution.calibration.covariance[np.ix_(columns, columns)]
    return float(np.array(error) @ np.linalg.solve(P, error)), len(error)


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "others"), [("dive-usbl", USBL), ("dive-lbl", (NET,))])
def test_calibration_and_net_are_as_good_as_they_say(scene, others):
    found = {names: [] for names in (DVL, *others)}
    for seed in range(SEEDS):
        trial = simulate(config(scene), seed)
        solution = solve(trial, rate_hz=1.0)
        for names, values in found.items():
            values.append(nees(solution, trial.calibration_truth, names))
        sigma = {name: solution.estimate(name).std.round(4) for name in chain(*found)}
        print(seed, solution.verdict.grade, [f"{v[-1][0]:.1f}" for v in found.values()], sigma)
        assert sigma["misalignment_deg"][2] <= 0.1
        assert np.all(sigma["lever_arm_m"][:2] <= 0.1)
    for names, values in found.items():
        size = values[0][1]
        low, high = nees_band(size, SEEDS, level=0.99)
        mean = np.mean([value for value, _ in values])
        print(names, f"NEES {mean / size:.2f}, band {low / size:.2f} to {high / size:.2f}")
        assert low < mean < high


def changed(trial, change):
    others = (change(a) if isinstance(a, Usbl) else a for a in trial.others)
    return replace(trial, others=tuple(others))


def gross(usbl):
    """Return the record with a tenth of its fixes wrong."""
    rng = np.random.default_rng(2)
    polar = usbl.polar.copy()
    wrong = rng.random(len(polar)) < 0.1
    polar[wrong, 0] += rng.uniform(5.0, 50.0, wrong.sum())
    polar[wrong, 1] = (polar[wrong, 1] + rng.normal(0.0, 0.5, wrong.sum())) % (2.0 * np.pi)
    return replace(usbl, polar=polar)


def start(trial):
    """Return where the minimisation of a trial starts."""
    if trial.imu is None:
        prepared = prepare_without_imu(trial)
    else:
        prepared = prepare(trial, 1.0, lambda *_: None)
    (states,) = prepared.start_positions.states
    return prepared.start(prepared.chain(states), states, lambda *_: None)


# Of thirteen dives, that whose start the wrong fixes led 3 km away when all of them counted.
@pytest.mark.slow
@pytest.mark.parametrize("without_imu", [False, True])
def test_gross_fixes_lead_no_start_elsewhere(without_imu):
    trial = simulate(config("dive-usbl", **(WITHOUT_IMU if without_imu else {})), 12)
    spoilt = changed(trial, gross)
    found = start(spoilt)
    assert np.linalg.norm(found.states.p_n - start(trial).states.p_n, axis=1).max() < 5.0
    wrong = np.any(spoilt.find(Usbl).polar != trial.find(Usbl).polar, axis=1)
    np.testing.assert_array_equal(found.robust_weights["USBL"][:, 0] == 0.0, wrong)


@pytest.mark.slow
def test_gross_fixes_hardly_change_the_calibration():
    errors = []
    for seed in range(SEEDS):
        trial = simulate(config("dive-usbl"), seed)
        pair = [solve(t, rate_hz=1.0) for t in (trial, changed(trial, gross))]
        truth = trial.calibration_truth
        std = {n: pair[0].estimate(n).std for n in DVL}
        errors.append(
            [
                np.concatenate([(s.estimate(n).value - truth[n]) / std[n] for n in DVL])
                for s in pair
            ]
        )
        print(seed, [s.verdict.grade for s in pair])
    clean, dirty = np.sqrt(np.mean(np.square(errors), axis=(0, 2)))
    print(f"RMS of error over σ without gross fixes: {clean:.2f}, with them {dirty:.2f}")
    assert dirty <= 1.2 * clean


@pytest.mark.slow
def test_a_transceiver_that_is_not_where_it_is_said_to_be_is_named():
    def at_the_reference_point(usbl):
        moved = msgspec.structs.replace(
            usbl.ship.settings, transceiver_lever_arm_m=(0.0, 0.0, 0.0)
        )
        settings = msgspec.structs.replace(usbl.settings, ship=moved)
        return replace(usbl, settings=settings, ship=replace(usbl.ship, settings=moved))

    solution = solve(changed(simulate(config("dive-usbl"), 1), at_the_reference_point))
    reasons = {r.code: str(r) for r in solution.verdict.reasons}
    assert "usbl_transceiver_lever_arm_m" in reasons[Code.ESTIMATED_INSTEAD]


@pytest.mark.slow
@pytest.mark.study
def test_without_imu_the_sum_of_compass_and_mount_is_as_good_as_its_bound():
    scene = config("dive-usbl", **WITHOUT_IMU)
    bound = heading_error(predict(scene).solution)["relative_std"]
    errors = []
    for seed in range(SEEDS):
        trial = simulate(scene, seed)
        solution = solve(trial, rate_hz=1.0)
        found = heading_error(solution)
        time, heading = trial.attitude.time, trial.attitude.rph[:, 2]
        at = trial.reference
        wrong = heading - np.interp(time, at.time, np.unwrap(at.rph[:, 2]))
        wrong = (wrong + np.pi) % (2.0 * np.pi) - np.pi
        mean = np.degrees(np.average(wrong, weights=np.gradient(time)))
        errors.append(found["relative"] - (trial.calibration_truth["misalignment_deg"][2] - mean))
        reasons = [r.code.value for r in solution.verdict.reasons]
        print(seed, errors[-1], found["relative_std"], bound, solution.verdict.grade, reasons)
        # Climbs are motion, which takes nothing of the noise of the DVL.
        assert Code.SMALL_RESIDUALS not in reasons
        assert found["relative_std"] < 1.2 * bound
        assert found["apart"].key == "heading_error.undetermined"
    low, high = nees_band(1, SEEDS, level=0.99)
    mean = np.mean(np.square(errors)) / bound**2
    print(f"NEES {mean:.2f}, band {low:.2f} to {high:.2f}")
    assert low < mean < high


def heading_error(solution):
    """Return the values of what is said of compass and mount."""
    (note,) = (f for f in solution.findings if f.code == Code.HEADING_ERROR)
    return dict(note.message.values)
