"""The mirror pair of a straight run: one of the two is right, and the innovations tell which."""

from __future__ import annotations

import numpy as np
import pytest
from planar import trial as planar_trial

from factorgraph_dvl.baselines.mirror_pair import both_tracks, mirror_pair
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.vectors import interpolate


def trial(*, current=(0.0, 0.0, 0.0), noise=False):
    return planar_trial(
        name="mirror",
        noise=noise,
        start={"lat_deg": 25.0, "lon_deg": 135.004},
        manoeuvres=[
            {"straight_s": 100},
            {"turn_deg_s": -3, "duration_s": 30},
            {"straight_s": 100},
        ],
        current_m_s=list(current),
    )


def truth(t, time):
    r = t.reference
    return t.frame().position(*interpolate(np.array([time]), r.time, r.geodetic).T)[0, :2]


def test_without_noise_and_current_one_of_the_two_is_exact():
    t = trial()
    pair, std = mirror_pair(t, (1.0, 40.0, 90.0))
    away = np.sort(np.linalg.norm(pair - truth(t, 1.0), axis=1))
    assert away[0] < 0.5
    assert away[1] > 100.0
    assert np.all(std > 10.0)


def test_the_innovations_keep_the_right_one():
    t = trial(current=(0.1, -0.05, 0.0), noise=True)
    tracks = both_tracks(t, "4sv-3ob", (1.0, 40.0, 90.0))
    end = truth(t, tracks.filtered[0].time[-1])
    kept, dropped = (np.linalg.norm(f.state[-1, :2] - end) for f in tracks.filtered)
    assert kept < 30.0 < 0.3 * dropped
    assert tracks.misfit[1] > 3.0 * tracks.misfit[0]


def test_ranges_of_no_straight_run_are_refused():
    t = trial()
    t.beacons.range[:] = np.sqrt(3e5 - 5.0 * t.beacons.time**2)
    with pytest.raises(DataError, match="do not fit a straight run"):
        mirror_pair(t, (1.0, 40.0, 90.0))
