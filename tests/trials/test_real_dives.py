"""Recorded dives with a raw IMU: mistakes are named one after the other, and dives agree."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dives import dive
from scipy.stats import chi2

from factorgraph_dvl.files.trial_folder import load_trial
from factorgraph_dvl.plausibility.survey import survey
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.sensors.dvl import DvlSettings
from factorgraph_dvl.sensors.imu import COLUMNS
from factorgraph_dvl.sensors.ins import InsSettings
from factorgraph_dvl.solvers.batch import solve

DIVES = Path(__file__).resolve().parents[3] / "shared" / "data" / "snapir_auv"
ALL = (1, 2, 3, 4, 8, 10)
# Clocks of the INS by its attitudes, which fit the integrated gyros within 0.003 deg there.
BY_ATTITUDE = {1: 0.415, 2: 0.455, 3: 0.465, 4: 0.425, 8: 0.415, 10: 0.455}
# What a user may state of them, without a start for clocks and antenna.
STATED = (
    "imu: {sampling: instantaneous, gyro_noise_deg_sqrt_h: .01, gyro_bias_std_deg_h: .1, "
    "accel_noise_ug_sqrt_hz: 500, accel_bias_std_ug: 200}\n"
    "gnss: {position_std_m: [.3, .3, .3], velocity_std_m_s: [.02, .02, .02], "
    "lever_arm_std_m: [5, 5, 5]}\n"
    "dvl: {velocity_std_m_s: 0.01, velocity_std_fraction: 0.002}\n",
    "imu: {sampling: instantaneous, gyro_noise_deg_sqrt_h: .06, gyro_bias_std_deg_h: .1, "
    "accel_noise_ug_sqrt_hz: 500, accel_bias_std_ug: 200}\n"
    "gnss: {position_std_m: [.05, .05, .05], velocity_std_m_s: [.005, .005, .005], "
    "lever_arm_std_m: [5, 5, 5], correlation_time_s: 60, correlated_std_m: [.2, .2, .2], "
    "velocity_correlation_time_s: 20, correlated_velocity_std_m_s: [.01, .01, .01]}\n"
    "dvl: {velocity_std_m_s: 0.003, velocity_std_fraction: 0.002}\n",
)
GNSS = "time_s,lat_deg,lon_deg,height_m,vel_e_m_s,vel_n_m_s,vel_u_m_s"
DVL = "time_s,vel_x_m_s,vel_y_m_s,vel_z_m_s"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not DIVES.is_dir(), reason=f"no recorded dives in {DIVES.name}"),
]


def written(folder, number, *, corrected, gnss="", dvl=""):
    """Write a dive as a trial: as recorded, or with axis and stamps corrected."""
    folder.mkdir(exist_ok=True)
    imu, motion, pings = (
        np.loadtxt(DIVES / f"{name}_trajectory{number}.csv{end}", delimiter=",", skiprows=1)
        for name, end in (("IMU", ".gz"), ("GT", ""), ("DVL", ""))
    )
    if corrected:
        imu[:, [2, 5]] *= -1.0
        for table, step in ((imu, 0.01), (motion, 1.0), (pings, 1.0)):
            table[:, 0] = step * np.arange(len(table))
    fixes = np.c_[motion[:, 0], np.degrees(motion[:, [2, 1]]), motion[:, [3, 5, 4]], -motion[:, 6]]
    for name, header, values in (
        ("imu", ",".join(COLUMNS), imu[:, [0, 4, 5, 6, 1, 2, 3]]),
        ("gnss", GNSS, fixes),
        ("dvl", DVL, pings),
    ):
        np.savetxt(
            folder / f"{name}.csv", values, delimiter=",", header=header, comments="", fmt="%.12g"
        )
    (folder / "trial.yaml").write_text(
        f"format: 1\nname: dive {number}\nbody_axes: FRD\nimu: {{grade: tactical}}\n"
        f"gnss: {{position_std_m: [0.5, 0.5, 0.5], velocity_std_m_s: [0.02, 0.02, 0.02]{gnss}}}\n"
        f"dvl: {{velocity_std_m_s: 0.01, velocity_std_fraction: 0.002{dvl}}}\n",
        encoding="utf-8",
    )
    return load_trial(folder)


def proposed(trial):
    """Return what the checks propose: both clocks and the antenna, as YAML."""
    texts = [str(f) for f in survey(trial).problems]
    (gnss, dvl) = (
        next(m[1] for t in texts if (m := re.search(rf"{s}: {{(time_offset_s: [-.\d]+)}}", t)))
        for s in ("gnss", "dvl")
    )
    (arm,) = (m[1] for t in texts if (m := re.search(r"antenna at (\[.*?\]) m", t)))
    offset = "time_offset_std_s: 0.05"
    antenna = f"lever_arm_m: {arm}, lever_arm_std_m: [0.1, 0.1, 0.1]"
    return {"gnss": f", {gnss}, {offset}, {antenna}", "dvl": f", {dvl}, {offset}"}


def test_mistakes_are_named_one_after_the_other(tmp_path):
    first = survey(written(tmp_path / "as it is", 2, corrected=False)).errors
    assert first[0].code == Code.IMU_AXES
    assert "axis y is mirrored" in first[0].text
    assert [(f.code, f.sensor) for f in first[1:]] == [
        (Code.CLOCK_DRIFT, "GNSS"),
        (Code.CLOCK_DRIFT, "DVL"),
    ]
    then = survey(written(tmp_path / "corrected", 2, corrected=True)).problems
    assert {f.code for f in then} == {Code.CLOCK_OFFSET, Code.ANTENNA}


def test_lever_arms_and_clocks_agree_with_what_the_checks_propose(tmp_path):
    dives = ALL[::2]
    arms, P, clocks = [], [], []
    for number in dives:
        found = proposed(written(tmp_path / f"{number}", number, corrected=True))
        solution = solve(written(tmp_path / f"{number}", number, corrected=True, **found))
        rows = [solution.order.index(f"lever_arm_{k}_m") for k in "xyz"]
        arms.append(solution.estimate("lever_arm_m").value)
        P.append(solution.covariance[np.ix_(rows, rows)])
        clocks.append(solution.estimate("time_offset_s").value[0])
        late = solution.estimate("gnss_time_offset_s").value[0] - BY_ATTITUDE[number]
        assert abs(late) < 0.02, number
    weights = np.linalg.inv(P)
    mean = np.linalg.solve(weights.sum(axis=0), np.einsum("dij,dj->i", weights, arms))
    left = np.array(arms) - mean
    statistic = float(np.einsum("di,dij,dj->", left, weights, left))
    assert statistic < chi2.ppf(0.99, 3 * (len(dives) - 1))
    assert np.ptp(clocks) < 0.025


@pytest.fixture(scope="module")
def stated_twice(tmp_path_factory):
    """Return the solutions of all dives with each statement of noise."""
    return [[plain(s, number, tmp_path_factory.mktemp("dive")) for number in ALL] for s in STATED]


@pytest.fixture(params=[0, 1], ids=["wide", "lasting"])
def plainly(request, stated_twice):
    """Return the solutions of all dives with one statement of noise."""
    return stated_twice[request.param]


def plain(stated, number, folder):
    written(folder, number, corrected=True)
    (folder / "trial.yaml").write_text(
        f"format: 1\nname: dive\nbody_axes: FRD\n{stated}", encoding="utf-8"
    )
    return solve(load_trial(folder), rate_hz=1.0)


def test_dives_settle_with_any_plain_statement(plainly):
    assert [s.converged for s in plainly] == [True] * len(ALL)
    # Accelerometers are late beside gyros, and noise is far below what is stated.
    assert [s.verdict.grade for s in plainly] == ["doubtful"] * len(ALL)
    # What vibrates is no noise.
    assert not any(f.code == Code.IMU_NOISE for s in plainly for f in s.findings)


def test_clocks_and_lever_arms_are_right_beside_a_propeller(plainly):
    """Clocks had a minimum every 0.042 s, or every 0.016 s: the INS follows no vibration."""
    for number, solution in zip(ALL, plainly, strict=True):
        clock = solution.estimate("gnss_time_offset_s")
        # Velocities of the INS are as late beside its attitudes in all of them.
        assert abs(clock.value[0] - BY_ATTITUDE[number] - 0.010) < 0.010, number
        assert clock.std[0] < 0.01
        arm = solution.estimate("lever_arm_m").value - solution.estimate("gnss_lever_arm_m").value
        # Dives agree on it to 0.010 m.
        assert abs(arm[0] + 1.857) < 0.025, number


# The longest in which the heading stays within 8 deg. That of dive 8 is left out: its clock of the
# INS is 0.4 s off with a standard deviation of 0.5 s, and its antenna 3.3 along z.
@pytest.mark.parametrize(
    ("number", "start", "end"),
    [(1, 233, 264), (2, 108, 128), (3, 187, 206), (4, 360, 390), (10, 145, 199)],
)
def test_a_straight_stretch_knows_what_it_does_not_show(tmp_path, number, start, end):
    """Of a whole dive, the antenna is 1.780 m ahead, and the DVL 0.079 m astern, of the IMU."""
    written(tmp_path, number, corrected=True)
    text = f"format: 1\nname: straight\nbody_axes: FRD\n{STATED[0]}"
    (tmp_path / "trial.yaml").write_text(text, encoding="utf-8")
    stretch = load_trial(tmp_path).until(end, since=start)
    solution = solve(stretch, rate_hz=1.0)
    assert solution.converged
    for name, expected in (
        ("gnss_lever_arm_m", (1.780, 0.012, 0.113)),
        ("lever_arm_m", (-0.079, -0.011, 0.203)),
        ("gnss_time_offset_s", (BY_ATTITUDE[number] + 0.010,)),
    ):
        found = solution.estimate(name)
        assert np.all(np.abs(found.value - expected) < 3.0 * np.hypot(found.std, 0.005)), name
        assert np.all(found.observable == (found.std <= 0.5 * found.prior_std)), name


def relative(solution, signs):
    """Return a sum of parameters with signs, and its variances."""
    names = [f"{name}{part}" for name in signs for part in signs[name][1]]
    rows = np.array([solution.order.index(name) for name in names]).reshape(len(signs), -1)
    values = np.concatenate([e.value for e in solution.estimates])[rows]
    weights = np.array([signs[name][0] for name in signs])
    blocks = solution.covariance[rows[:, None, :], rows[None, :, :]]
    return weights @ values, np.einsum("i,ijk,j->k", weights, blocks, weights)


AXES, ONE = ("_x_m", "_y_m", "_z_m"), ("",)
# Lever arm from antenna to DVL, scale and yaw of its mounting.
SHARED = (
    {"lever_arm": (1.0, AXES), "gnss_lever_arm": (-1.0, AXES)},
    {"scale_error": (1.0, ONE)},
    {"misalignment_z_deg": (1.0, ONE)},
)


def of_dives(solutions):
    """Return x, y, scale and yaw that dives share, and their standard deviations, (dives, 4)."""
    found = [[np.stack(relative(s, each)) for each in SHARED] for s in solutions]
    every = np.array([np.hstack(each) for each in found])[:, :, [0, 1, 3, 4]]
    return every[:, 0], np.sqrt(every[:, 1])


def test_dives_agree(plainly):
    """The noise of an IMU was found in what the INS had made of it, and chi2 was 5 a dive."""
    value, std = of_dives(plainly)
    mean = np.sum(value / std**2, axis=0) / np.sum(std**-2, axis=0)
    assert np.all(np.sum(((value - mean) / std) ** 2, axis=0) < 2.5 * (len(ALL) - 1))
    assert np.all(std < [0.02, 0.01, 1e-3, 0.2])


def test_what_is_stated_of_noise_hardly_changes_a_dive(stated_twice):
    (one, std), (other, _) = map(of_dives, stated_twice)
    assert np.all(np.abs(one - other)[:, [0, 2]] < 0.5 * std[:, [0, 2]])
    assert np.all(np.abs(one - other) < std)


@pytest.fixture(scope="module")
def both_ways(tmp_path_factory):
    folder = tmp_path_factory.mktemp("both") / "dive"
    found = proposed(written(folder, 2, corrected=True))
    with_imu = solve(written(folder, 2, corrected=True, **found), rate_hz=1.0)
    return with_imu, solve(dive(2), rate_hz=1.0)


def agree(both_ways, there, here):
    # Both have the same pings, so that the sum of the variances is the most that may differ.
    a, b = relative(both_ways[0], there), relative(both_ways[1], here)
    return np.all(np.abs(a[0] - b[0]) < 3.0 * np.sqrt(a[1] + b[1]))


@pytest.mark.parametrize(
    ("there", "here"),
    [
        # The reference point of the dive is the antenna of the one, and the body of the other.
        ({"lever_arm": (1.0, AXES), "gnss_lever_arm": (-1.0, AXES)}, {"lever_arm": (1.0, AXES)}),
        ({"misalignment_z_deg": (1.0, ONE)}, {"misalignment_z_deg": (1.0, ONE)}),
        ({"scale_error": (1.0, ONE)}, {"scale_error": (1.0, ONE)}),
    ],
    ids=["lever_arm", "misalignment", "scale"],
)
def test_a_dive_with_its_imu_and_without_gives_the_same(both_ways, there, here):
    assert both_ways[0].converged
    assert both_ways[1].converged
    assert agree(both_ways, there, here)


def test_a_dive_with_its_imu_and_without_has_the_same_clock(both_ways):
    there = {"time_offset_s": (1.0, ONE), "gnss_time_offset_s": (-1.0, ONE)}
    assert agree(both_ways, there, {"time_offset_s": (1.0, ONE)})


@pytest.fixture(scope="module")
def without_imu():
    return [solve(plainly_stated(number), rate_hz=1.0) for number in ALL]


def plainly_stated(number):
    """Return a dive without its IMU, stated as data sheets of its sensors do."""
    trial = dive(number)
    (ins,) = trial.others
    dvl = DvlSettings(velocity_std_m_s=0.01, velocity_std_fraction=0.002)
    stated = InsSettings(
        position_std_m=(0.3, 0.3, 0.3),
        velocity_std_m_s=(0.02, 0.02, 0.02),
        attitude_std_deg=(0.02, 0.02, 0.05),
    )
    others = (replace(ins, settings=stated),)
    return replace(trial, dvl=replace(trial.dvl, settings=dvl), others=others)


def test_dives_without_imu_settle(without_imu):
    assert [s.converged for s in without_imu] == [True] * len(ALL)
    # Nothing of an INS's output is a gross error.
    assert not any(s.rejected for s in without_imu)
    assert [s.verdict.grade for s in without_imu] == ["doubtful"] * len(ALL)


def with_bias(solution):
    """Whether a bias of the DVL was estimated that is far larger than stated."""
    return any(f.code == Code.ESTIMATED_INSTEAD for f in solution.findings)


def test_no_bias_of_a_dvl_is_thirty_times_stated(without_imu):
    assert not [n for n, s in zip(ALL, without_imu, strict=True) if with_bias(s)]


@pytest.mark.parametrize(
    ("name", "row"), [("lever_arm_m", 0), ("lever_arm_m", 1), ("scale_error", 0)]
)
def test_dives_without_imu_agree(without_imu, name, row):
    value, std = (
        np.array([getattr(s.estimate(name), part)[row] for s in without_imu])
        for part in ("value", "std")
    )
    mean = np.sum(value / std**2) / np.sum(std**-2)
    assert np.sum(((value - mean) / std) ** 2) < 2.5 * (len(ALL) - 1)


def test_what_is_stated_of_lasting_errors_counts_as_stated(without_imu):
    """Errors of an INS's position last: a process of 0.3 m is no more than was stated."""
    for solution in without_imu:
        (position,) = (n for n in solution.noise if n.name == "ins_position")
        assert np.all(position.factor < 1.1)
