"""IMU, GNSS and DVL against each other: each mistake is named by its true cause."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
import yaml
from truth import CONFIGS, config, scenario

from factorgraph_dvl.plausibility.survey import survey
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import faults, instrument_faults, parse_scenario, simulate
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.trial import Trial

SWAP_XY = np.eye(3)[[1, 0, 2]]
TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def mirror(axis: int) -> np.ndarray:
    return np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))


@pytest.fixture(scope="module")
def trial() -> Trial:
    """Three minutes of swell, turns and changes of speed; GNSS and DVL at 2 Hz, IMU at 50 Hz."""
    legs = [
        {"straight_s": 12},
        {"turn_deg_s": -6, "duration_s": 20, "ramp_s": 4},
        {"accelerate_m_s2": -0.2, "to_m_s": 2},
        {"turn_deg_s": 8, "duration_s": 15, "ramp_s": 4},
        {"accelerate_m_s2": 0.2, "to_m_s": 4},
    ]
    scene = scenario(
        noise=True,
        manoeuvres=[{"repeat": 3, "manoeuvres": legs}],
        imu={"rate_hz": 50},
        gnss={
            "rate_hz": 2,
            "position_std_m": [0.02, 0.02, 0.04],
            "velocity_std_m_s": [0.03, 0.03, 0.03],
        },
        dvl={"rate_hz": 2},
    )
    return simulate(scene, 3)


def found(trial: Trial, *changes: faults.Fault) -> dict[Code, str]:
    problems = survey(faults.with_faults(trial, changes)).problems
    return {finding.code: str(finding) for finding in problems}


def test_a_right_trial_has_no_problems(trial: Trial) -> None:
    assert found(trial) == {}


@pytest.mark.slow
def test_a_dvl_that_takes_its_tilt_out_is_no_mistake_of_the_imu() -> None:
    """Gyros in degrees would hardly turn, and axes y and z swapped would sway no DVL either."""
    plan = yaml.safe_load((CONFIGS / "dive.yaml").read_text(encoding="utf-8"))
    next(m for m in plan["manoeuvres"] if "repeat" in m)["repeat"] = 1
    plan["gnss"]["outages_s"] = [[305, 1080]]
    del plan["dvl"]["no_lock_s"]
    plan["trial"] = {}
    dive = simulate(parse_scenario(plan), 0)
    levelled = faults.with_faults(dive, [instrument_faults.dvl_levelled()])
    assert not [str(f) for f in survey(levelled).problems if f.severity == "error"]


# In seed 11, slow turns and noise that persists looked like a jump of 0.7 s of the GNSS clock.
@pytest.mark.parametrize(
    "seed", [11, *(pytest.param(k, marks=pytest.mark.slow) for k in range(10))]
)
def test_errors_of_data_sheets_are_no_problem(seed: int) -> None:
    assert survey(simulate(CONFIGS / "data-sheet-mix-navigation.yaml", seed)).problems == ()


@pytest.mark.parametrize("late", [0.3, -4.0])
def test_late_stamps_are_found_with_their_offset(trial: Trial, late: float) -> None:
    for section in ("gnss", "dvl"):
        (text,) = found(trial, faults.late(section, late)).values()
        assert ("late" if late > 0 else "early") in text
        stated = float(text.rpartition(f"{section}: {{time_offset_s: ")[2].rstrip("}"))
        assert stated == pytest.approx(late, abs=0.025)


def test_an_offset_that_the_prior_covers_is_a_warning(trial: Trial) -> None:
    def severity(stated: float) -> str:
        late = faults.with_faults(trial, [faults.late("dvl", 0.2)])
        assert late.dvl is not None
        settings = msgspec.structs.replace(late.dvl.settings, time_offset_std_s=stated)
        (finding,) = survey(replace(late, dvl=replace(late.dvl, settings=settings))).problems
        assert finding.code == Code.CLOCK_OFFSET
        return finding.severity

    assert severity(0.0) == "error"
    assert severity(0.5) == "warning"


def test_leap_seconds_and_local_time_are_called_so(trial: Trial) -> None:
    assert Code.LEAP_SECONDS in found(trial, faults.late("gnss", 18.0))
    assert Code.LOCAL_TIME in found(trial, faults.late("gnss", 7200.0))


def test_a_clock_that_runs_fast_is_not_one_that_is_off(trial: Trial) -> None:
    text = found(trial, faults.clock_rate("dvl", 2500.0))
    assert list(text) == [Code.CLOCK_DRIFT]
    assert "25" in text[Code.CLOCK_DRIFT]


def test_a_clock_that_jumps_is_named_with_its_time(trial: Trial) -> None:
    assert trial.dvl is not None
    time = trial.dvl.time
    middle = float(time.mean())
    jumped = replace(trial, dvl=replace(trial.dvl, time=time + 0.6 * (time > middle)))
    (text,) = found(jumped).values()
    assert "jumps by 0.6" in text or "jumps by 0.59" in text


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (mirror(1), "axis y is mirrored"),
        pytest.param(mirror(0), "axis x is mirrored", marks=pytest.mark.slow),
        pytest.param(SWAP_XY, "axes x and y are swapped", marks=pytest.mark.slow),
    ],
)
def test_a_mirrored_imu_is_named_with_its_axis(
    trial: Trial, matrix: np.ndarray, words: str
) -> None:
    texts = found(trial, faults.axes_changed("imu", matrix.tolist()))
    assert list(texts) == [Code.IMU_AXES]
    assert f"for gyros and accelerometers, {words}" in texts[Code.IMU_AXES]


@pytest.mark.parametrize(
    ("matrix", "field", "code", "words"),
    [
        (mirror(2), "gyro", Code.GYRO_AXES, "for the gyros, axis z is mirrored"),
        pytest.param(
            *(mirror(1), "accel", Code.ACCEL_AXES, "for the accelerometers, axis y is mirrored"),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *(SWAP_XY, "gyro", Code.GYRO_AXES, "for the gyros, axes x and y are swapped"),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *(-np.eye(3), "gyro", Code.GYRO_AXES, "for the gyros, all three axes"),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *(np.eye(3) * 180.0 / np.pi, "gyro", Code.GYRO_UNIT, "deg/s"), marks=pytest.mark.slow
        ),
    ],
)
def test_one_triad_of_other_axes_or_units_is_named(
    trial: Trial, matrix: np.ndarray, field: str, code: Code, words: str
) -> None:
    texts = found(trial, faults.axes_changed("imu", matrix.tolist(), field))
    assert code in texts
    assert words in texts[code]


def test_the_signs_of_pd0_are_mirrored_axes(trial: Trial) -> None:
    texts = found(trial, faults.axes_changed("dvl", (-np.eye(3)).tolist()))
    assert "all three axes have the opposite sign, as in PD0" in texts[Code.DVL_AXES]
    assert "[2, 2, 30]" in texts[Code.DVL_AXES]


def test_wrong_body_axes_are_seen_in_the_course(trial: Trial) -> None:
    (text,) = found(replace(trial, body_axes="FLU")).values()
    assert "the axes look like RFU" in text
    (text,) = found(trial, faults.axes_changed("imu", TURNED.tolist())).values()
    assert "mounted turned about the vertical" in text


def test_another_antenna_is_found(trial: Trial) -> None:
    (text,) = found(trial, faults.wrong_antenna((2.0, 0.0, 0.0))).values()
    assert "not at the [2.0, 0.0, 0.0] m" in text


@pytest.mark.slow
def test_swapped_fixes_without_velocities_are_found(trial: Trial) -> None:
    assert trial.gnss is not None
    geodetic = trial.gnss.geodetic
    change = (geodetic - geodetic[0])[:, [1, 0, 2]]
    swapped = replace(
        trial.gnss,
        geodetic=np.array([0.6, 0.9, 0.0]) + change,
        velocity=np.full_like(geodetic, np.nan),
    )
    texts = found(replace(trial, gnss=swapped))
    assert "latitude and longitude" in texts[Code.GNSS_AXES]


@pytest.mark.parametrize(
    "fault",
    [
        faults.correlated_gnss((0.5, 0.5, 0.5), (0.05, 0.05, 0.05)),
        faults.gnss_outliers(),
        faults.dvl_outliers(),
        pytest.param(faults.dvl_outliers(0.3), marks=pytest.mark.slow),
        pytest.param(faults.dvl_false_lock(duration_s=20.0), marks=pytest.mark.slow),
        pytest.param(faults.dvl_bias((0.01, 0.0, 0.0)), marks=pytest.mark.slow),
        pytest.param(faults.jitter("dvl", 0.005), marks=pytest.mark.slow),
    ],
)
def test_noise_and_outliers_are_no_mistakes_of_axes_or_clocks(
    trial: Trial, fault: faults.Fault
) -> None:
    assert found(trial, fault) == {}


def test_a_straight_run_says_nothing_of_axes() -> None:
    scene = scenario(
        noise=True,
        sway={},
        manoeuvres=[{"straight_s": 90}],
        imu={"rate_hz": 50},
        dvl={"rate_hz": 1},
        gnss={"rate_hz": 1},
    )
    straight = simulate(scene, 1)
    assert (
        found(
            straight, faults.axes_changed("dvl", (-np.eye(3)).tolist()), faults.late("gnss", 2.0)
        )
        == {}
    )


def test_a_dead_channel_of_the_imu_is_named(trial: Trial) -> None:
    gyro = trial.imu.gyro.copy()
    gyro[:, 1] = 0.0
    texts = found(replace(trial, imu=replace(trial.imu, gyro=gyro)))
    assert "gyro_y_rad_s is always 0" in texts[Code.IMU_CHANNEL]
    gyro = trial.imu.gyro.copy()
    gyro[1000:1025] = gyro[1000]
    texts = found(replace(trial, imu=replace(trial.imu, gyro=gyro)))
    assert "all gyros repeat one value from 20.0 to 20.5 s" in texts[Code.FROZEN_VALUES]
    frozen = trial.imu.accel.copy()
    frozen[1000:1200] = frozen[1000]
    texts = found(replace(trial, imu=replace(trial.imu, accel=frozen)))
    assert "all accelerometers repeat one value from 20.0 to 24" in texts[Code.FROZEN_VALUES]


@pytest.mark.slow
def test_noise_that_is_larger_than_stated_is_no_mistake_of_axes() -> None:
    legs = [
        {"accelerate_m_s2": 1, "to_m_s": 4},
        {"straight_s": 150},
        {"turn_deg_s": -2, "duration_s": 45},
        {"straight_s": 150},
        {"turn_deg_s": 9, "duration_s": 50},
        {"straight_s": 100},
    ]
    sway = simulate(config("data-sheet-mix-navigation", manoeuvres=legs), 0)
    assert sway.gnss is not None
    stated = replace(sway.gnss, velocity_std=0.2 * sway.gnss.velocity_std)
    assert Code.GNSS_AXES not in found(replace(sway, gnss=stated))


def test_a_saturated_channel_is_named_and_a_coarse_one_is_not(trial: Trial) -> None:
    limit = 0.95 * float(np.abs(trial.inertial.gyro[:, 1]).max())
    text = found(trial, faults.saturated(gyro_rad_s=limit))[Code.SATURATED]
    assert "gyro_y_rad_s is never" in text
    assert f"{limit:.4g}, and is that" in text
    coarse = replace(trial.inertial, gyro=np.round(trial.inertial.gyro, 3))
    assert Code.SATURATED not in found(replace(trial, imu=coarse))


def test_a_stuck_axis_of_the_dvl_is_named(trial: Trial) -> None:
    (text,) = found(trial, faults.stuck("dvl", 2)).values()
    assert "vel_z_m_s is always" in text


def test_what_is_wrong_for_a_while_is_no_clock_that_jumps(trial: Trial) -> None:
    assert Code.CLOCK_STEP not in found(trial, faults.dvl_false_lock(1.0, 40.0))


def test_stamps_that_scatter_mirror_no_axes_and_move_no_clock(trial: Trial) -> None:
    """Nothing that is wrong throughout explains them."""
    texts = found(trial, faults.jitter("dvl", 0.5))
    assert not {Code.DVL_AXES, Code.CLOCK_OFFSET, Code.LEAP_SECONDS} & set(texts)


def test_a_clock_that_drifts_by_a_period_of_the_sway_mirrors_no_axes() -> None:
    """Sway at 2 Hz, and 0.45 s over the trial."""
    sway = {
        "roll": [{"amplitude_deg": 4, "frequency_hz": 2}],
        "pitch": [{"amplitude_deg": 4, "frequency_hz": 2, "phase_deg": 90}],
    }
    legs = [{"straight_s": 30}, {"turn_deg_s": 6, "duration_s": 30, "ramp_s": 4}]
    scene = scenario(noise=True, sway=sway, manoeuvres=[{"repeat": 3, "manoeuvres": legs}])
    text = found(simulate(scene, 2), faults.clock_rate("dvl", 2500.0))
    assert list(text) == [Code.CLOCK_DRIFT]


def test_spikes_of_the_imu_are_named(trial: Trial) -> None:
    (text,) = found(trial, faults.imu_spikes(0.001)).values()
    assert "single samples differ" in text


def test_a_single_spike_of_the_imu_is_named(trial: Trial) -> None:
    def spike(trial: Trial, rng: np.random.Generator) -> Trial:
        accel = trial.inertial.accel.copy()
        accel[2000, 0] += 10.0
        return replace(trial, imu=replace(trial.inertial, accel=accel))

    (text,) = found(trial, spike).values()
    assert "1 single sample differs" in text


def test_jitter_of_stamps_is_named_where_it_adds_to_the_noise(trial: Trial) -> None:
    (text,) = found(trial, faults.jitter("imu", 0.002)).values()
    assert "scatter by 2 ms about even intervals of 20 ms" in text
    assert found(trial, faults.jitter("imu", 1e-6)) == {}


def test_spikes_below_the_integrated_noise_hide_no_other_error(trial: Trial) -> None:
    """Three steps of 35 deviations among 11,250 samples add less than the noise does."""

    def few(trial: Trial, rng: np.random.Generator) -> Trial:
        accel = trial.inertial.accel.copy()
        second = np.diff(accel[:, 2], 2)
        accel[[2000, 4000, 6000], 2] += 35.0 * 0.5 * np.median(np.abs(second))
        return replace(trial, imu=replace(trial.inertial, accel=accel))

    assert list(found(trial, few)) == []
    assert list(found(trial, few, faults.late("dvl", 0.3))) == [Code.CLOCK_OFFSET]


def swaying_turns() -> Trial:
    """Steady turns under sway at 2 Hz: by a period, nearly the same motion is measured."""
    legs = [{"straight_s": 40}, {"turn_deg_s": 9, "duration_s": 40}]
    sway = {
        "roll": [{"amplitude_deg": 4, "frequency_hz": 2}],
        "pitch": [{"amplitude_deg": 4, "frequency_hz": 2, "phase_deg": 90}],
    }
    moving = {"repeat": 2, "manoeuvres": legs}
    return simulate(scenario(noise=True, sway=sway, manoeuvres=[moving]), 2)


@pytest.mark.slow
def test_clocks_that_are_off_by_periods_of_the_sway_are_found() -> None:
    trial = swaying_turns()
    assert found(trial) == {}
    text = found(trial, faults.late("dvl", 3.0))[Code.CLOCK_OFFSET]
    assert "time_offset_s: 3.00" in text
    assert Code.LEAP_SECONDS in found(trial, faults.late("gnss", 18.0))


def test_small_steps_of_a_clock_are_errors(trial: Trial) -> None:
    """Nothing that is estimated takes them up."""
    problems = survey(faults.with_faults(trial, [faults.clock_step("dvl", 0.1)])).problems
    assert [(p.code, p.severity) for p in problems] == [(Code.CLOCK_STEP, "error")]


@pytest.mark.slow
def test_a_mirrored_axis_is_named_where_sway_hides_the_clock() -> None:
    """Gyros and accelerometers contradict each other; a clock all but fits GNSS and DVL."""
    for axis in (0, 1):
        texts = found(swaying_turns(), faults.axes_changed("imu", mirror(axis).tolist()))
        assert Code.IMU_AXES in texts
        assert f"axis {'xyz'[axis]} is mirrored" in texts[Code.IMU_AXES]


@pytest.fixture(scope="module")
def dive() -> Trial:
    """Ten minutes under water: GNSS sees the vehicle go straight, and the DVL sees its turns."""
    scene = yaml.safe_load((CONFIGS / "dive.yaml").read_text())
    legs = next(m for m in scene["manoeuvres"] if "repeat" in m)
    legs["repeat"] = 1
    scene["gnss"]["outages_s"] = [[305, 1080]]
    return simulate(parse_scenario(scene), 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("matrix", "fields", "code", "words"),
    [
        (mirror(0), (), Code.IMU_AXES, "gyros and accelerometers, axis x is mirrored"),
        (SWAP_XY, (), Code.IMU_AXES, "gyros and accelerometers, axes x and y are swapped"),
        (mirror(1), ("accel",), Code.ACCEL_AXES, "accelerometers, axis y is mirrored"),
    ],
)
def test_one_mistake_is_named_rather_than_another_and_a_mirrored_dvl(
    dive: Trial, matrix: np.ndarray, fields: tuple[str, ...], code: Code, words: str
) -> None:
    """The wrong motion is large, and what it leaves unexplained is a small share of it."""
    texts = found(dive, faults.axes_changed("imu", matrix.tolist(), *fields))
    assert list(texts) == [Code.GAPS, code]
    assert words in texts[code]


@pytest.mark.slow
def test_a_solve_says_that_the_bow_is_elsewhere(dive: Trial) -> None:
    """No residual shows it, and who goes straight may go sideways: doubtful."""
    solution = solve(faults.with_faults(dive, [faults.body_axes_misstated("FLU")]), rate_hz=1.0)
    assert solution.verdict.grade == "doubtful"
    assert Code.COURSE in [reason.code for reason in solution.verdict.reasons]
