"""The verdict of a replay as it goes: it changes with the data, and knows none of the future."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import scenario

from factorgraph_dvl.estimates import Estimate, Trajectory
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.replay.calibration import CalibrationEstimate
from factorgraph_dvl.replay.playback import VerdictAsItGoes
from factorgraph_dvl.replay.record import Update
from factorgraph_dvl.simulation import simulate

NOWHERE = Trajectory(*(np.zeros(0) for _ in range(7)))


@pytest.fixture(scope="module")
def trial():
    legs = [{"straight_s": 10}, {"turn_deg_s": -6, "duration_s": 20, "ramp_s": 4}]
    return simulate(scenario(noise=True, manoeuvres=[{"repeat": 5, "manoeuvres": legs}]), 1)


def update(time, std=0.01, value=0.0, findings=(), inconsistent=()):
    three = np.ones(3)
    names = tuple(f"misalignment_{k}_deg" for k in "xyz")
    estimate = Estimate(
        "misalignment_deg", names, value * three, std * three, 0 * three, 5.0 * three, three > std
    )
    calibration = CalibrationEstimate((estimate,), std**2 * np.eye(3))
    return Update(
        time, 0.01, lambda: NOWHERE, lambda: NOWHERE, lambda: calibration, None, (),
        tuple(findings), False, inconsistent,
    )  # fmt: skip


def grades(trial, updates):
    verdict = VerdictAsItGoes(trial)
    out = []
    for each in updates:
        verdict.take(each)
        out.append(verdict.at(each))
    return out


def test_it_changes_as_more_is_known_and_as_sensors_agree_again(trial):
    poor, good, odd, again = grades(
        trial,
        [
            update(20.0, std=0.5),
            update(30.0),
            update(40.0, inconsistent=("DVL velocity",)),
            update(50.0, findings=[Finding(Code.HEARD_AGAIN, "back", "DVL")]),
        ],
    )
    assert [v.grade for v in (poor, good, odd, again)] == ["doubtful", "good", "doubtful", "good"]
    assert poor.reasons[0].code == Code.UNCERTAIN
    assert odd.reasons[0].code == Code.CONTRADICTS


def test_what_was_said_of_a_record_lasts(trial):
    jump = Finding(Code.CLOCK_JUMP, "jumps")
    assert grades(trial, [update(20.0, findings=[jump]), update(30.0)])[1].reasons == (jump,)


def test_a_value_far_from_its_prior_is_named_when_it_is_known(trial):
    (verdict,) = grades(trial, [update(20.0, value=60.0)])
    assert verdict.reasons[0].code == Code.FAR_FROM_PRIOR


def test_wrong_axes_are_found_once_there_are_data_that_show_them(trial):
    mirrored = replace(trial, dvl=replace(trial.dvl, velocity=-trial.dvl.velocity))
    early, late = grades(mirrored, [update(30.0), update(130.0)])
    assert early.grade == "good"
    assert late.reasons[0].code == Code.DVL_AXES
