"""`$PIXSE` as a navigation solution: a published burst, with and without a date."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest
from format_samples import PIXSE
from format_writers import nmea

from factorgraph_dvl.files.formats import pixse

DEG = np.pi / 180.0


def read(tmp_path, data):
    path = tmp_path / "log.txt"
    path.write_bytes(data)
    return list(pixse.read(path))


def test_a_published_burst_is_a_navigation_solution(tmp_path):
    (batch,) = read(tmp_path, PIXSE.replace(b"116.581,T*25", b"116.581,T*00") + PIXSE)
    assert (batch.kind, batch.clock, batch.heading) == ("ins", "day", "true")
    # Where the checksum of its heading is wrong a burst has none.
    assert np.isnan(batch.records["heading"][0])
    last = batch.records[1]
    assert last["time"] == pytest.approx(33 * 60 + 56.016693)
    angles = [last[name] / DEG for name in ("roll", "pitch", "heading")]
    np.testing.assert_allclose(angles, (-1.641, 0.490, 116.581))
    np.testing.assert_allclose([last["lat"] / DEG, last["lon"] / DEG], (53.10245714, 8.83994382))
    np.testing.assert_allclose(last["velocity"], (-0.802, -1.243, 0.0))
    np.testing.assert_allclose(last["std"], (18004.65, 20563.20, 50.0))
    np.testing.assert_allclose(last["attitude_std"] / DEG, (0.082, 0.101, 1.997))
    level = np.sqrt((19.747**2 + 13.032**2) / 2.0)
    np.testing.assert_allclose(last["velocity_std"], (level, level, 10.002))
    assert any("reversed" in note for note in batch.notes)


def test_a_sentence_with_a_date_dates_it(tmp_path):
    (batch,) = read(tmp_path, nmea("GPZDA,003355.00,25,07,2022,00,00") + PIXSE)
    when = datetime(2022, 7, 25, 0, 33, 56, 16693, UTC).timestamp()
    assert batch.clock == "utc"
    assert batch.records["time"][0] == pytest.approx(when, abs=1e-5)


def test_attitude_alone(tmp_path):
    data = nmea("HEHDT,10.0,T") + nmea("PIXSE,ATITUD,1.0,2.0") + nmea("PIXSE,TIME__,000001.5")
    (batch,) = read(tmp_path, data)
    assert batch.kind == "attitude"
    angles = [batch.records[name][0] / DEG for name in ("roll", "pitch", "heading")]
    np.testing.assert_allclose(angles, (1.0, -2.0, 10.0))


def test_its_share_is_that_of_its_sentences(tmp_path):
    assert pixse.share(tmp_path, PIXSE) > 0.8
    assert pixse.share(tmp_path, nmea("GPHDT,1.0,T") * 50) == 0.0
