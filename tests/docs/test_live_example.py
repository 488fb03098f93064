"""The live example: lines from a socket, cut and damaged ones, links that break."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

import factorgraph_dvl as fd

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def live():
    return runpy.run_path(str(ROOT / "examples" / "live.py"))


@pytest.fixture(scope="module")
def trial():
    return fd.simulate(ROOT / "examples" / "short.yaml", seed=1)


def test_lines_come_back_as_what_was_measured(live, trial):
    feed = live["Feed"](trial)
    taken = {"gnss": [], "dvl": []}
    feed.replay.add = lambda record: taken[record.section].append(record)
    feed.replay.add_imu = lambda *samples: []
    for line in live["recorded_lines"](trial):
        feed.line(line)
    assert not feed.damaged
    velocity = np.concatenate([record.velocity for record in taken["dvl"]])
    np.testing.assert_allclose(velocity, trial.dvl.velocity, atol=1e-5)
    place = np.concatenate([record.geodetic for record in taken["gnss"]])
    np.testing.assert_allclose(place[:, :2], trial.gnss.geodetic[:, :2], atol=1e-12)
    np.testing.assert_allclose(place[:, 2], trial.gnss.geodetic[:, 2], atol=1e-4)


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"$GPGGA,120000.00,3600.0,N,12100.0,E,4*00",
        b"$PIMU,1.0,0,0*",
        b"wrz,1,2,3,y*ZZ",
        b"\xff\xfe*12",
    ],
)
def test_a_damaged_line_is_counted(live, trial, line):
    feed = live["Feed"](trial)
    assert feed.line(line) == []
    assert sum(feed.damaged.values()) == 1


def test_a_checksum_by_hand(live):
    # The example of the standard's usual description.
    body = b"GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"
    assert live["checksum"](body) == 0x47
    assert live["crc8"](b"123456789") == 0xF4


def test_lines_are_whole_across_broken_links(live):
    sent = [b"line %d\n" % i for i in range(300)]
    port = live["serve"](sent, breaks=2)
    got = list(live["lines"]("127.0.0.1", port, attempts=2))
    assert got[0] == b"line 0"
    assert got[-1] == b"line 299"
    plain = [line for line in got if b"damaged" not in line]
    assert set(plain) < {line.rstrip() for line in sent}
    assert len(got) - len(plain) == 2


@pytest.mark.slow
def test_the_short_run_is_calibrated_live(live, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["live.py"])
    live["main"]()
    out = capsys.readouterr().out
    assert "good  misalignment_deg green, scale_error green, lever_arm_m green" in out
    assert "damaged lines: 2" in out
