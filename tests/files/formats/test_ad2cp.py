"""AD2CP: a real file against mhkit, and a writer that follows the document."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import format_writers as writers
import numpy as np
import pytest

from factorgraph_dvl.files.formats import ad2cp
from factorgraph_dvl.files.formats.ad2cp import read as read_batches
from factorgraph_dvl.files.formats.framing import map_file
from factorgraph_dvl.files.importing.raw_files import import_files
from factorgraph_dvl.files.tables import read_table
from factorgraph_dvl.settings.yaml_file import read_yaml

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
    assert (ping["coordinates"], ping["beams"], ping["number"]) == (ad2cp.IN_BEAMS, 4, 77)
    np.testing.assert_allclose(ping["rotation"].ravel(), ahrs[:9])
    np.testing.assert_allclose(ping["rate"], ahrs[13:] * DEG)
    assert text == ["GETBT,RANGE=30\r\nX"]


def test_other_scale_and_no_orientation():
    (ping,) = read(record(scale=-3, frame=1))[0]
    np.testing.assert_allclose(ping["velocity"][:3], [1.5, -0.25, 0.0])
    assert ping["coordinates"] == ad2cp.IN_XYZ
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


def batches(tmp_path, data):
    path = tmp_path / "log.ad2cp"
    path.write_bytes(data)
    return {batch.stream: batch for batch in read_batches(path) if len(batch.records)}


def test_tracks_of_a_dvl(tmp_path):
    moved = writers.df21(WHEN, (1.5, -0.25, 0.1, 0.3), (0.1, 0.2, 0.3, 0.4), (9, 10, 11, 12))
    # X and the second beam are not valid; no distance, no figure of merit, one vertical.
    lost = writers.df21(
        WHEN,
        (-32.768, -0.25, -32.768, 0.3),
        (0.1, -32.768, 0.3, 0.4),
        (9, 0, 11, 12),
        merit=10.0,
        status=0xFFFFF & ~(1 << 12) & ~(1 << 1),
    )
    data = writers.ad2cp(0x1B, moved) + writers.ad2cp(0x1D, moved) + writers.ad2cp(0x1B, lost)
    data += writers.ad2cp(0x1B, moved[:100])
    found = batches(tmp_path, data)
    bottom, water = found["bottom"], found["water"]
    assert (bottom.kind, water.kind, bottom.clock) == ("dvl", "water", "own")
    whole, lost = bottom.records
    np.testing.assert_allclose(whole["velocity"], [1.5, -0.25, 0.2], atol=1e-7)
    np.testing.assert_allclose(whole["error"], -0.1, atol=1e-7)
    np.testing.assert_allclose(whole["beams"], [0.1, 0.2, 0.3, 0.4], atol=1e-7)
    np.testing.assert_allclose(whole["range"], [9, 10, 11, 12])
    np.testing.assert_allclose(whole["std"], 0.01, atol=1e-8)
    np.testing.assert_allclose([whole["delay"], whole["sound_speed"]], [0.02, 1490.0], atol=1e-8)
    np.testing.assert_allclose(whole["window"], 0.005, rtol=1e-6)
    assert whole["time"] == pytest.approx(WHEN.timestamp(), abs=1e-6)
    np.testing.assert_allclose(lost["velocity"], [np.nan, -0.25, 0.3], atol=1e-7)
    np.testing.assert_allclose(lost["beams"], [0.1, np.nan, 0.3, 0.4], atol=1e-7)
    assert np.isnan(lost["std"]).all()
    assert np.isnan(lost["range"][1])
    np.testing.assert_array_equal(water.records["velocity"][0], whole["velocity"])
    assert any("DT1" in note for note in bottom.notes)


def test_beams_of_bottom_track_become_beams_of_the_trial(tmp_path):
    theta = 25.0 * DEG
    across, down = 1 / (2 * np.sin(theta)), 1 / (4 * np.cos(theta))
    matrix = [[across, 0, -across, 0], [0, -across, 0, across], [down] * 4, [down] * 4]
    cells = (f"M{i + 1}{j + 1}={matrix[i][j]:.6f}" for i in range(4) for j in range(4))
    text = f"\x10GETXFBT,ROWS=4,COLS=4,{','.join(cells)}\r\n\0".encode()
    velocity = np.array([1.2, -0.4, 0.1])
    outward = np.linalg.pinv(np.array(matrix[:3]))
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 1.0, atol=1e-12)
    pings = [
        writers.df20(WHEN + timedelta(seconds=i), outward @ velocity, (9.0,) * 4, (5,) * 4)
        for i in range(20)
    ]
    data = writers.ad2cp(0xA0, text) + b"".join(writers.ad2cp(0x17, ping) for ping in pings)
    (ping, *_) = batches(tmp_path, data)["bottom"].records
    np.testing.assert_allclose(ping["beams"], outward @ velocity, atol=1e-5)
    np.testing.assert_allclose(ping["velocity"], velocity, atol=1e-4)
    import_files([tmp_path / "log.ad2cp"], tmp_path / "trial")
    settings = read_yaml(tmp_path / "trial" / "trial.yaml", dict)
    np.testing.assert_allclose(settings["dvl_beams"]["directions"], outward, atol=2e-5)
    names = [f"beam{i}_m_s" for i in range(1, 5)]
    table = read_table(tmp_path / "trial" / "dvl_beams.parquet", names)
    np.testing.assert_allclose([table[name][7] for name in names], outward @ velocity, atol=1e-5)
