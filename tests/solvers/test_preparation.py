"""From a trial to where its minimisation starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import solved

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.solvers.preparation import mounted_start, prepare


@pytest.fixture(scope="module")
def stages():
    """Stages that were reported on the way."""
    return []


@pytest.fixture(scope="module")
def prepared(stages):
    trial, _ = solved.turning()
    return prepare(trial, 1.0, lambda stage, iteration, cost: stages.append(stage))


def test_every_stage_is_reported(prepared, stages):
    assert stages[:2] == ["increments", "alignment"]


def test_states_are_a_second_apart_and_measurements_those_of_all_sensors(prepared):
    trial, _ = solved.turning()
    step = np.diff(prepared.segments.node_time)
    np.testing.assert_allclose(step, 1.0, atol=0.02)
    labels = {o.label for o in prepared.observations}
    assert labels == {"GNSS position", "GNSS velocity", "DVL velocity"}
    # Unless a trial says that its noise is as stated, that is only where to start.
    assert prepared.estimated_noise == labels
    stated = prepare(replace(trial, noise="stated"), 1.0, lambda *_: None)
    assert stated.estimated_noise == frozenset()
    names = [p.name for p in prepared.parameters]
    assert len(names) == len(set(names))
    assert {"misalignment_deg", "scale_error", "lever_arm_m"} <= set(names)


def test_reference_and_truth_have_no_part_in_the_result(prepared):
    trial, _ = solved.turning()
    assert trial.reference is not None
    assert trial.calibration_truth
    assert prepared.trial.reference is None
    assert not prepared.trial.calibration_truth


def test_states_and_mounting_to_start_from_are_near_the_truth(prepared):
    trial, _ = solved.turning()
    (states,) = prepared.start_positions.states
    chain = prepared.chain(states)
    start = mounted_start(prepared, chain, states, lambda *_: None)
    states, values = start.states, start.values
    assert start.iterations > 0
    assert not start.robust_weights
    truth = exp_so3(trial.calibration_truth["misalignment_deg"] * DEG)
    off = np.linalg.norm(log_so3(truth.T @ values["misalignment_deg"])) / DEG
    assert off < 2.0
    assert np.abs(values["lever_arm_m"] - trial.calibration_truth["lever_arm_m"]).max() < 1.0
    reference = trial.reference
    frame = trial.frame()
    true = frame.position(*reference.geodetic.T)
    at = np.stack([np.interp(chain.segments.node_time, reference.time, x) for x in true.T], axis=1)
    assert np.abs(states.p_n - at)[1:-1].max() < 2.0


def test_what_the_imu_recorded_by_another_clock_is_left_out_and_said():
    trial, _ = solved.turning()
    late = 1e8
    imu = replace(trial.imu, time=trial.imu.time + late * (trial.imu.time > 2.0))
    aids = (replace(aid, time=aid.time + late) for aid in (trial.gnss, trial.dvl))
    moved = replace(trial, imu=imu, **dict(zip(("gnss", "dvl"), aids, strict=True)))
    found = prepare(moved, 1.0, lambda *_: None)
    assert found.segments.node_time.min() > late
    assert Code.CLOCK_RESTARTED in {f.code for f in found.findings}


def test_a_trial_without_a_position_is_refused():
    trial, _ = solved.turning()
    with pytest.raises(DataError, match="position"):
        prepare(replace(trial, gnss=None), 1.0, lambda *_: None)


@pytest.mark.parametrize("size", [10.0, 50.0])
def test_jumps_of_gnss_turn_no_mounting_that_is_started_from(prepared, size):
    """Fixes 50 m off for a tenth of the trial."""
    trial, _ = solved.turning()
    fixes = trial.gnss.geodetic.copy()
    jump = slice(len(fixes) // 2, len(fixes) // 2 + len(fixes) // 10)
    fixes[jump, 2] += 0.1 * size
    fixes[jump, :2] += size / 6.4e6
    jumping = replace(trial, gnss=replace(trial.gnss, geodetic=fixes))
    other = prepare(jumping, 1.0, lambda *_: None)
    (states,) = other.start_positions.states
    start = mounted_start(other, other.chain(states), states, lambda *_: None)
    (weights,) = start.robust_weights.values()
    out = np.flatnonzero(weights[:, 0] == 0.0)
    np.testing.assert_array_equal(out, np.arange(jump.start, jump.stop))
    truth = exp_so3(trial.calibration_truth["misalignment_deg"] * DEG)
    off = np.linalg.norm(log_so3(truth.T @ start.values["misalignment_deg"])) / DEG
    assert off < 2.0
