"""Recorded ships and vehicles without their IMU: an INS, or GNSS with a compass."""

from __future__ import annotations

import numpy as np
import pytest
from dives import DATA, dive
from scipy.special import chdtri

from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.sensors.attitude import Attitude, AttitudeSettings
from factorgraph_dvl.sensors.dvl import Dvl, DvlSettings
from factorgraph_dvl.sensors.gnss import Gnss, GnssSettings
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.trial import Trial


def found(number):
    solution = solve(dive(number), rate_hz=1.0)
    assert solution.converged
    return solution


def check_clock(solution):
    # An independent fit: 1.41 to 1.51 s by dive.
    clock = solution.estimate("time_offset_s")
    assert clock.std[0] < 0.025
    assert 1.41 - 4.0 * clock.std[0] < -clock.value[0] < 1.51 + 4.0 * clock.std[0]


@pytest.mark.slow
def test_a_dive_without_its_imu_gives_lever_arm_and_clock():
    solution = found(2)
    assert solution.estimate("lever_arm_m").value[0] == pytest.approx(-1.84, abs=0.1)
    check_clock(solution)
    assert -solution.estimate("misalignment_deg").value[2] == pytest.approx(-0.2, abs=0.25)


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 3, 4, 8, 10])
def test_every_dive_agrees(number):
    solution = found(number)
    assert solution.estimate("lever_arm_m").value[0] == pytest.approx(-1.84, abs=0.1)
    check_clock(solution)
    assert -solution.estimate("misalignment_deg").value[2] == pytest.approx(-0.2, abs=0.25)


@pytest.mark.slow
def test_six_dives_scatter_as_their_standard_deviations_say():
    solutions = [found(number) for number in (1, 2, 3, 4, 8, 10)]
    for name, component in (("misalignment_deg", 2), ("scale_error", 0), ("lever_arm_m", 0)):
        estimates = [solution.estimate(name) for solution in solutions]
        values = np.array([e.value[component] for e in estimates])
        weights = np.array([e.std[component] ** -2.0 for e in estimates])
        squares = float(weights @ (values - np.average(values, weights=weights)) ** 2)
        # 0.999 of what five degrees of freedom give; all dives share the errors of one INS, which
        # each standard deviation contains, so that less is no sign of an error.
        assert squares < chdtri(5.0, 0.001), name


def boat():
    folder = DATA / "lake_boat"
    if not folder.is_dir():
        pytest.skip(f"no recorded boat in {folder}")

    def table(name):
        path = folder / f"lake_2019-11-01_{name}.csv"
        return np.genfromtxt(path, delimiter=",", names=True)

    adcp, fixes, compass = table("adcp"), table("gga"), table("hdt")
    # Looking down, and bow where -Y is: right, forward, up.
    velocity = np.stack([adcp["iv1"], -adcp["iv2"], -adcp["iv3"]], axis=1)
    velocity[np.abs(velocity).max(axis=1) > 80.0] = np.nan
    unknown = np.full(velocity.shape, np.nan)
    dvl = Dvl(
        DvlSettings(velocity_std_m_s=0.05, time_offset_std_s=5.0), adcp["t_s"], velocity, unknown
    )
    of_day = fixes["utc_s_of_day"]
    time = of_day + np.median(fixes["ens_t_s"] - of_day)
    degrees = np.stack([fixes["lat_deg"], fixes["lon_deg"], fixes["alt_msl_m"]], axis=1)
    unknown = np.full(degrees.shape, np.nan)
    gnss = Gnss(
        GnssSettings(position_std_m=(0.5, 0.5, 1.0)),
        time,
        degrees * [DEG, DEG, 1.0],
        unknown,
        unknown.copy(),
        unknown.copy(),
    )
    _, first = np.unique(compass["ens_t_s"], return_index=True)
    rph = np.full((first.size, 3), np.nan)
    rph[:, 2] = compass["heading_true_deg"][first] * DEG
    settings = AttitudeSettings(std_deg=(2.0, 2.0, 0.3))
    attitude = Attitude(settings, compass["ens_t_s"][first], rph)
    return Trial("lake boat", None, gnss=gnss, dvl=dvl, others=(attitude,))


@pytest.mark.slow
def test_a_boat_with_a_gnss_compass_without_tilt():
    solution = solve(boat(), rate_hz=1.0)
    assert solution.converged
    assert -solution.estimate("misalignment_deg").value[2] == pytest.approx(1.65, abs=1.0)
    correction = 1.0 / (1.0 + solution.estimate("scale_error").value[0])
    assert correction == pytest.approx(0.992, abs=0.006)
    # A straight run shows no lever arm that is good enough, and none along the vertical. To
    # starboard, 233 pings at the recorded yaw rate of 0.23 deg/s rms are the most that can show
    # it; part of that rate is noise of the compass, 0.3 deg from second to second.
    noise = next(n for n in solution.noise if n.name == "dvl_velocity")
    least = 0.05 * noise.factor[1] / (0.23 * DEG * np.sqrt(233.0))
    std = solution.estimate("lever_arm_m").std
    assert std[0] > 0.2
    assert least < std[1] < 2.0 * least
    assert std[2] > 9.0
    # An independent fit: 1.6 s.
    clock = solution.estimate("time_offset_s")
    assert abs(clock.value[0] + 1.6) < 2.0 * clock.std[0]
