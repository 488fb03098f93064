"""Start values of mountings: which sensors come first, and near which fixes."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from calibrations import calibration
from truth import scenario

from factorgraph_dvl.files.earlier_calibration import calibrated_by
from factorgraph_dvl.initialization.mountings import _near_fixes, mounted_aids
from factorgraph_dvl.sensors.gnss import Gnss, GnssSettings
from factorgraph_dvl.simulation import simulate


@pytest.fixture(scope="module")
def trial():
    star = {"rate_hz": 2, "std_arcsec": 5}
    scene = scenario(
        manoeuvres=[{"straight_s": 5}], epoch="2018-12-01T05:30:00Z", star=star,
        trial={"star": {"mounting_std_deg": [5, 5, 5]}},
    )  # fmt: skip
    return simulate(scene)


def test_gnss_and_what_is_mounted_come_before_the_dvl(trial):
    assert mounted_aids(trial, {}) == [trial.gnss]
    known = {"star_mounting_deg": np.eye(3)}
    assert mounted_aids(trial, known) == [trial.gnss, *trial.others]


def test_a_calibrated_dvl_needs_no_motion_without_it(trial):
    dvl = calibrated_by(trial.dvl, calibration(), trial.body_axes, "before.json")
    assert mounted_aids(replace(trial, dvl=dvl), {}) is None
    # Nor can there be one without GNSS.
    assert mounted_aids(replace(trial, gnss=None), {}) is None


def test_fixed_mountings_are_mounted(trial):
    (star,) = trial.others
    fixed = msgspec.structs.replace(star.settings, mounting_std_deg=(0, 0, 0))
    others = (replace(star, settings=fixed),)
    assert mounted_aids(replace(trial, others=others), {}) == [trial.gnss, *others]


def test_ten_seconds_from_a_fix_are_near():
    time = np.array([0.0, 50.0, 60.0])
    nothing = np.full((3, 3), np.nan)
    # At 50 s only a velocity, at 60 s nothing.
    geodetic, velocity = nothing.copy(), nothing.copy()
    geodetic[0], velocity[1] = 0.5, 1.0
    gnss = Gnss(GnssSettings(), time, geodetic, velocity, nothing, nothing.copy())
    near = _near_fixes(gnss, np.array([9.0, 11.0, 41.0, 59.0, 61.0]))
    assert near.tolist() == [True, False, True, True, False]
    assert _near_fixes(None, np.zeros(2)).all()
