"""Excerpts of recordings, against what mhkit made of the whole files."""

from pathlib import Path

import numpy as np
import pytest

from factorgraph_dvl.files.formats import ad2cp
from factorgraph_dvl.files.formats.framing import map_file
from factorgraph_dvl.files.formats.pd0 import read_pd0
from factorgraph_dvl.files.importing.raw_files import import_files
from factorgraph_dvl.files.importing.recognition import recognise

FOLDER = Path(__file__).resolve().parents[2] / "data" / "recordings"
DEG = np.pi / 180.0
# Velocities in the files have a resolution of 1 mm/s; mhkit's numbers are of single precision.
SAME = 1e-5


@pytest.fixture(scope="module")
def oracle():
    with np.load(FOLDER / "mhkit.npz") as decoded:
        return {name: decoded[name] for name in decoded.files}


@pytest.mark.parametrize("name", ["winriver02_transect.PD0", "winriver01.PD0", "vmdas01_wh.ENX"])
def test_pd0_is_mhkits(name, oracle):
    path = FOLDER / name
    theirs = {
        key.removeprefix(f"{path.stem}_"): values
        for key, values in oracle.items()
        if key.startswith(path.stem)
    }
    (block,) = read_pd0(map_file(path))
    assert len(block.pings) == theirs["vel"].shape[2]
    np.testing.assert_allclose(block.water.transpose(2, 1, 0), theirs["vel"], atol=SAME)
    if "vel_bt" in theirs:
        # mhkit passes on what stands for a velocity that was not measured.
        expected = np.where(theirs["vel_bt"] < -32.0, np.nan, theirs["vel_bt"])
        np.testing.assert_allclose(block.pings["bottom_velocity"].T, expected, atol=SAME)
        far = np.nan_to_num(block.pings["bottom_range"].T)
        np.testing.assert_allclose(far, theirs["dist_bt"], atol=1e-4)
    for angle in ("heading", "pitch", "roll"):
        np.testing.assert_allclose(block.pings[angle] / DEG, theirs[angle], atol=1e-4)


@pytest.mark.parametrize("name", ["winriver02_transect.PD0", "winriver01.PD0"])
def test_every_fix_is_kept(name):
    path = FOLDER / name
    (block,) = read_pd0(map_file(path))
    assert len(block.nmea["GGA"]) == path.read_bytes().count(b"$GPGGA") > 1
    assert np.isfinite(block.nmea["GGA"]["lat"]).all()


def test_fixes_of_vmdas_are_mhkits(oracle):
    (block,) = read_pd0(map_file(FOLDER / "vmdas01_wh.ENX"))
    for name, other in (("lat", "latitude_gps"), ("lon", "longitude_gps")):
        # Single precision of mhkit: 1e-5 degrees.
        expected = oracle[f"vmdas01_wh_{other}"]
        np.testing.assert_allclose(block.vmdas[f"first_{name}"] / DEG, expected, atol=2e-5)


def test_ad2cp_is_mhkits(oracle, monkeypatch):
    # No ping of this recording found the bottom; compared is what is stored all the same.
    monkeypatch.setattr(ad2cp, "_mark_lost", lambda _: None)
    (block,) = ad2cp.read_ad2cp(map_file(FOLDER / "VelEchoBT01.ad2cp"))
    for name, other, unit in (
        ("velocity", "vel_bt", 1.0),
        ("distance", "dist_bt", 1.0),
        ("merit", "fom_bt", 1.0),
        ("heading", "heading_bt", DEG),
        ("pitch", "pitch_bt", DEG),
        ("rate", "angrt_bt", 1.0),
    ):
        expected = oracle[f"VelEchoBT01_{other}"]
        np.testing.assert_allclose(block.bottom[name].T / unit, expected, atol=1e-4)
    np.testing.assert_allclose(block.bottom["velocity"].T, oracle["VelEchoBT01_vel_bt"], atol=SAME)


@pytest.mark.parametrize(
    "name",
    ["winriver02_transect.PD0", "winriver01.PD0", "vmdas01_wh.ENX", "VelEchoBT01.ad2cp"],
)
def test_an_excerpt_becomes_a_trial(name, tmp_path):
    (form,) = recognise(FOLDER / name)
    assert form.name == ("ad2cp" if name.endswith("ad2cp") else "pd0")
    decisions = import_files([FOLDER / name], tmp_path / "trial")
    assert (tmp_path / "trial" / "trial.yaml").exists()
    lacks = [line.partition(":")[0] for line in decisions.missing]
    assert lacks == (["positions", "velocities"] if form.name == "ad2cp" else [])
