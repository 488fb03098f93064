"""What is mistaken in the record of a USBL is named before anything is solved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import config

import factorgraph_dvl as fd
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.sensors.usbl import Usbl

BOX = [
    {"straight_s": 60},
    {"turn_deg_s": 4.5, "duration_s": 20, "ramp_s": 4},
    {"straight_s": 60},
    {"turn_deg_s": 4.5, "duration_s": 20, "ramp_s": 4},
    {"straight_s": 40},
]


@pytest.fixture(scope="module", params=["gyros", "compass"])
def trial(request):
    changes = {"manoeuvres": BOX, "imu": {"rate_hz": 20}}
    if request.param == "compass":
        changes["imu"] = None
        changes["attitude"] = {"rate_hz": 5, "white_std_deg": [0.1, 0.1, 0.3]}
        changes["trial"] = {"imu": None}
    return fd.simulate(config("dive-usbl", **changes), seed=3)


def found(trial, change):
    others = tuple(change(a) if isinstance(a, Usbl) else a for a in trial.others)
    codes = (Code.USBL_AXES, Code.USBL_TRACK, Code.USBL_RUN)
    return [f for f in fd.survey(replace(trial, others=others)).findings if f.code in codes]


def problems(trial, change):
    return [f for f in found(trial, change) if f.severity != "ok"]


def seen(change):
    def changed(usbl):
        nothing = np.full(usbl.polar.shape, np.nan)
        return replace(usbl, polar=nothing, cartesian=change(usbl.in_transceiver))

    return changed


def from_north(usbl):
    bow = np.interp(usbl.time, usbl.ship.time, np.unwrap(usbl.ship.rph[:, 2]))
    polar = usbl.polar + np.column_stack([0.0 * bow, bow, 0.0 * bow])
    polar[:, 1] %= 2.0 * np.pi
    return replace(usbl, polar=polar)


def test_a_record_that_is_right_has_no_finding(trial):
    (finding,) = found(trial, lambda usbl: usbl)
    assert finding.severity == "ok"


def test_gross_errors_that_come_alone_are_left_to_the_solver(trial):
    def gross(usbl):
        rng = np.random.default_rng(2)
        polar = usbl.polar.copy()
        wrong = rng.random(len(polar)) < 0.1
        polar[wrong, 0] += rng.uniform(5.0, 50.0, wrong.sum())
        return replace(usbl, polar=polar)

    assert problems(trial, gross) == []


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (seen(lambda at: at * [1.0, -1.0, 1.0]), "the bearing is mirrored"),
        (seen(lambda at: at / 1500.0), "the range is a travel time in s"),
        (seen(lambda at: at / 1.5), "the range is a travel time in ms"),
        (from_north, "the bearing is from north"),
    ],
)
def test_a_mistake_is_named(trial, change, text):
    (finding,) = found(trial, change)
    assert finding.code == Code.USBL_AXES
    assert finding.severity == "error"
    assert text in str(finding)


def test_another_transponder_for_a_while_is_named_with_its_times(trial):
    def swapped(usbl):
        polar = usbl.polar.copy()
        polar[30:45] = [60.0, 4.0, 0.9]
        return replace(usbl, polar=polar)

    usbl = trial.find(Usbl)
    (finding,) = found(trial, swapped)
    assert finding.code == Code.USBL_RUN
    assert f"from {usbl.time[30]:.1f} to {usbl.time[44]:.1f} s"[:10] in str(finding)


def test_the_record_of_another_vehicle_is_not_explained(trial):
    rng = np.random.default_rng(5)

    def other(usbl):
        walk = np.cumsum(rng.normal(0.0, 3.0, usbl.polar.shape), axis=0)
        nothing = np.full(usbl.polar.shape, np.nan)
        return replace(usbl, polar=nothing, cartesian=walk + np.array([20.0, 30.0, 50.0]))

    (finding,) = found(trial, other)
    assert "another transponder" in str(finding)


def test_a_vehicle_that_stays_within_the_noise_is_no_other_one():
    hover = [{"straight_s": 30}, {"turn_deg_s": 4.5, "duration_s": 20, "ramp_s": 4}] * 4
    changes = {
        "manoeuvres": hover,
        "imu": {"rate_hz": 20},
        "start": {"speed_m_s": 0.02},
        "usbl": {"angle_std_deg": 2.0},
    }
    (finding,) = found(fd.simulate(config("dive-usbl", **changes), seed=3), lambda usbl: usbl)
    assert finding.severity == "ok"


def test_a_mistake_is_refused_with_its_reason(trial):
    mirrored = seen(lambda at: at * [1.0, -1.0, 1.0])
    others = tuple(mirrored(a) if isinstance(a, Usbl) else a for a in trial.others)
    with pytest.raises(DataError, match="the bearing is mirrored"):
        fd.solve(replace(trial, others=others))
