"""Recordings of real instruments, from the raw file to a trial folder."""

import re
from pathlib import Path

import numpy as np
import pytest

from factorgraph_dvl import solve
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.importing.raw_files import import_files
from factorgraph_dvl.files.tables import read_table
from factorgraph_dvl.files.trial_folder import load_trial
from factorgraph_dvl.settings.yaml_file import read_yaml

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
NENANA = DATA / "nenana_river" / "nenana_2010-09-23.PD0"
WINRIVER = DATA / "adcp_raw" / "winriver01.PD0"
VMDAS = DATA / "adcp_raw" / "vmdas01_wh.ENX"
ECHO = DATA / "adcp_raw" / "VelEchoBT01.ad2cp"


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    done = {}

    def run(path):
        if not path.exists():
            pytest.skip(f"{path.name} is not within reach")
        if path not in done:
            out = tmp_path_factory.mktemp("import") / "trial"
            done[path] = out, import_files([path], out)
        return done[path]

    return run


def columns(out, table, *names):
    found = read_table(out / f"{table}.parquet", names)
    return np.stack([found[name] for name in names], axis=1)


def test_keeps_every_fix_of_winriver(imported):
    # As the published decode of the same file has them.
    out, decisions = imported(NENANA)
    path = DATA / "nenana_river" / "nenana_2010-09-23_gga.csv"
    table = np.genfromtxt(path, delimiter=",", names=True)
    position = columns(out, "gnss", "time_s", "lat_deg", "lon_deg")
    assert len(position) == 2321
    latitudes = next(table[n] for n in table.dtype.names if n.startswith("lat"))
    longitudes = next(table[n] for n in table.dtype.names if n.startswith("lon"))
    assert set(np.round(position[:, 1], 9)) <= set(np.round(latitudes, 9))
    assert set(np.round(position[:, 2], 9)) <= set(np.round(longitudes, 9))
    np.testing.assert_allclose(np.diff(position[:, 0]), 0.2, atol=1e-3)
    assert any("-8 h, local time" in line for line in decisions.lines)


def test_velocity_is_that_of_the_boat(imported):
    # Turned by the heading and by what the compass is off, it is that of GNSS.
    out, _ = imported(NENANA)
    velocity = columns(out, "dvl", "time_s", "vel_x_m_s", "vel_y_m_s", "vel_z_m_s")
    attitude = columns(out, "attitude", "time_s", "heading_deg")
    gnss = columns(out, "gnss", "time_s", "vel_e_m_s", "vel_n_m_s")
    gnss = gnss[np.isfinite(gnss).all(axis=1)]
    heading = np.deg2rad(np.interp(velocity[:, 0], attitude[:, 0], attitude[:, 1]))
    across, ahead = velocity[:, 1], velocity[:, 2]
    log = (ahead + 1j * across) * np.exp(1j * heading)
    time = velocity[:, 0]
    ground = np.interp(time, gnss[:, 0], gnss[:, 2]) + 1j * np.interp(time, gnss[:, 0], gnss[:, 1])
    locked = np.isfinite(log)
    assert locked.sum() == 610
    ratio = np.vdot(log[locked], ground[locked]) / np.vdot(log[locked], log[locked])
    assert abs(abs(ratio) - 1.0) < 0.03
    # With the declination the independent fit of 17.9° leaves 2°; without, the offset says it.
    assert (
        np.rad2deg(np.angle(ratio)) == pytest.approx(17.0, abs=3.0)
        or abs(np.rad2deg(np.angle(ratio))) < 4.0
    )


def test_heights_are_above_the_ellipsoid(imported):
    out, decisions = imported(WINRIVER)
    assert columns(out, "gnss", "height_m").shape == (34, 1)
    assert any("separation (-28.1 m)" in line for line in decisions.lines)
    assert any("-4 h, local time, and -26.34 s" in line for line in decisions.lines)


def test_water_track_takes_the_place_of_bottom_track(imported):
    out, decisions = imported(VMDAS)
    settings = read_yaml(out / "trial.yaml", dict)
    assert settings["dvl"]["reference"] == "water"
    assert len(columns(out, "gnss", "time_s")) == 3714
    assert any("EB is 15.80°" in line for line in decisions.lines)
    load_trial(out)


def test_says_what_a_file_lacks(imported):
    out, decisions = imported(ECHO)
    assert decisions.missing[0].startswith("positions: no file has any")
    assert decisions.missing[1].startswith("velocities: 159 pings, and none of them")
    assert "missing: positions" in (out / "import.log").read_text()
    with pytest.raises(DataError, match=re.escape(decisions.missing[0])):
        solve(load_trial(out))


def test_leaves_nothing_beside_the_input(imported):
    if not ECHO.exists():
        pytest.skip("no recording is within reach")
    before = sorted(ECHO.parent.iterdir())
    imported(ECHO)
    assert sorted(ECHO.parent.iterdir()) == before


UNSETTLED = pytest.mark.xfail(
    # Which of them settle is not known of every state of the solver.
    strict=False,
    reason="rare fixes and a compass of 2 deg: the strengths of the motion do not settle, or "
    "misfits are taken for a change along the trial; the verdict is `do not use`",
)


@pytest.fixture(scope="module")
def solved(imported):
    done = {}

    def run(path):
        if path not in done:
            out, _ = imported(path)
            done[path] = solve(load_trial(out))
        return done[path]

    return run


@pytest.mark.slow
@pytest.mark.study
@pytest.mark.parametrize("path", [NENANA, WINRIVER], ids=lambda path: path.stem)
def test_from_raw_file_to_a_scale(solved, path):
    # Fits of velocities alone give scales within 2 % of 1.
    scale = solved(path).estimate("scale_error")
    assert abs(float(scale.value[0])) < 0.02 + 3.0 * float(scale.std[0])


@pytest.mark.slow
@pytest.mark.study
@UNSETTLED
@pytest.mark.parametrize("path", [NENANA, WINRIVER, VMDAS], ids=lambda path: path.stem)
def test_from_raw_file_to_verdict(solved, path):
    assert solved(path).verdict.grade == "doubtful"


@pytest.mark.slow
@pytest.mark.study
@UNSETTLED
def test_a_current_in_a_tidal_race_leaves_a_scale_that_contains_none(solved):
    # At 0.01 to 1.2 m/s over ground, in a current that changes within half a minute.
    scale = solved(VMDAS).estimate("scale_error")
    assert abs(scale.value[0]) < 2.0 * scale.std[0]
    assert 0.03 < scale.std[0] < 0.15
