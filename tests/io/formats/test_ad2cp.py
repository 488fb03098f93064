"""AD2CP: a real file against mhkit, and a writer that follows the document."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from pathlib import Path

import format_writers as writers
import numpy as np
import pytest

from factorgraph_dvl.io.formats import ad2cp
from factorgraph_dvl.io.formats.framing import map_file

FILE = Path(__file__).resolve().parents[4] / "shared" / "data" / "adcp_raw" / "VelEchoBT01.ad2cp"
WHEN = datetime(2020, 1, 22, 4, 10, 33, 123400, UTC)
DEG = np.pi / 180.0


def read(data):
    parts = list(ad2cp.read_ad2cp(data))
    return np.concatenate([part.bottom for part in parts]), [
        t for part in parts for t in part.text
    ]


@pytest.mark.skipif(not FILE.exists(), reason=f"{FILE} is not here")
def test_the_real_file_is_mhkits(tmp_path, monkeypatch):
    dolfyn = pytest.importorskip("mhkit.dolfyn")
    shutil.copy(FILE, tmp_path / FILE.name)
    theirs = dolfyn.read(str(tmp_path / FILE.name))
    bottom, text = read(map_file(FILE))
    assert len(bottom) == theirs.sizes["time"] == 159
    # Nothing was ever tracked: no distance, and the merit at its limit.
    assert np.isnan(bottom["velocity"]).all()
    assert np.isnan(bottom["distance"]).all()
    monkeypatch.setattr(ad2cp, "_mark_lost", lambda _: None)
    raw, _ = read(map_file(FILE))
    np.testing.assert_allclose(raw["velocity"].T, theirs["vel_bt"].values, atol=1e-5)
    np.testing.assert_allclose(raw["distance"].T, theirs["dist_bt"].values, atol=1e-5)
    np.testing.assert_array_equal(raw["merit"].T, theirs["fom_bt"].values)
    for name in ("heading", "pitch", "roll"):
        np.testing.assert_allclose(raw[name] / DEG, theirs[f"{name}_bt"].values, atol=1e-4)
    np.testing.assert_allclose(raw["rate"].T, theirs["angrt_bt"].values, atol=1e-6)
    np.testing.assert_allclose(raw["acceleration"].T, theirs["accel_bt"].values, atol=1e-5)
    np.testing.assert_allclose(raw["quaternion"].T, theirs["quaternions_bt"].values)
    np.testing.assert_allclose(np.diff(raw["time"]), 0.5, atol=2e-4)
    assert "GETBT,RANGE=30.00" in text[0]
    matrix = ad2cp.beam_matrix(text[0])
    theta = 25.0 * DEG
    np.testing.assert_allclose(
        matrix[0], [1 / (2 * np.sin(theta)), 0, -1 / (2 * np.sin(theta)), 0], atol=1e-4
    )


def record(**more):
    values = {
        "velocity": (1.5, -0.25, 0.0, 2.0),
        "distance": (10.5, 11.0, 12.0, -1.022),
        "merit": (5, 6, 7, 8),
    }
    return writers.ad2cp(0x17, writers.df20(WHEN, **(values | more)))


def test_what_was_written_is_read():
    ahrs = np.arange(16.0)
    bottom, text = read(
        writers.ad2cp(0xA0, b"\x10GETBT,RANGE=30\r\nX\0") + record(heading=271.25, ahrs=ahrs)
    )
    (ping,) = bottom
    np.testing.assert_allclose(ping["velocity"], [1.5, -0.25, 0.0, np.nan])
    np.testing.assert_allclose(ping["distance"], [10.5, 11.0, 12.0, np.nan])
    assert ping["time"] == pytest.approx(WHEN.timestamp(), abs=1e-6)
    assert ping["heading"] / DEG == pytest.approx(271.25)
    assert (ping["coordinates"], ping["beams"], ping["number"]) == (ad2cp.BEAM, 4, 77)
    np.testing.assert_allclose(ping["rotation"].ravel(), ahrs[:9])
    np.testing.assert_allclose(ping["rate"], ahrs[13:] * DEG)
    assert text == ["GETBT,RANGE=30\r\nX"]


def test_other_scale_and_no_orientation():
    (ping,) = read(record(scale=-3, frame=1))[0]
    np.testing.assert_allclose(ping["velocity"][:3], [1.5, -0.25, 0.0])
    assert ping["coordinates"] == ad2cp.XYZ
    assert np.isnan(ping["rate"]).all()


def test_damage_costs_only_what_it_hits():
    flipped = bytearray(record())
    flipped[60] ^= 1
    data = (
        record()
        + b"\xa5\x0a"
        + bytes(flipped)
        + record()[:100]
        + b"\xa5" * 30
        + record()
        + record()[:-1]
    )
    assert len(read(data)[0]) == 2


def test_a_long_header():
    data = writers.df20(WHEN, (1.0,) * 4, (5.0,) * 4, (1,) * 4)
    head = bytes([0xA5, 12, 0x17, 0x10]) + len(data).to_bytes(4, "little")
    head += writers.word_sum(data).to_bytes(2, "little")
    head += writers.word_sum(head).to_bytes(2, "little")
    assert len(read(head + data)[0]) == 1
