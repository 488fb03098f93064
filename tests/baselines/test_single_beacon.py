"""The filters of single-beacon navigation, and when they have not converged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from findings import of_code
from planar import STRAIGHT, changed, error_of, trial
from truth import scenario

from factorgraph_dvl.baselines.single_beacon import filter_planar, run_filter
from factorgraph_dvl.cli import main
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.estimates import Residuals
from factorgraph_dvl.files.trial_folder import save_trial
from factorgraph_dvl.geometry.vectors import interpolate
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.quality.results import contradictions
from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.trial import InitialPosition


def test_a_trial_that_is_not_planar_is_refused():
    with pytest.raises(ConfigError, match="is not planar"):
        filter_planar(simulate(scenario()), "4sv-2ob")


def test_the_filters_start_from_a_position_only():
    with pytest.raises(DataError, match=r"initial\.position"):
        filter_planar(trial(), "4sv-3ob")
    start = {"initial": {"position_std_m": [5, 5, 1]}}
    t = trial(5, trial=start)
    for method in ("4sv-2ob", "4sv-3ob"):
        solution, history = filter_planar(t, method)
        error = error_of(t, solution)
        assert np.hypot(*error[-1]) < 20.0
        assert history.names == ("current_e_m_s", "current_n_m_s")
        assert np.all(np.diff(history.std[:, 0]) < 1e-3)


def test_the_filters_pass_over_missing_headings_and_depths():
    t = trial(5, trial={"initial": {"position_std_m": [5, 5, 1]}})
    compass = t.records[0]
    heading, depth = compass.heading.copy(), t.depth.depth.copy()
    heading[5:8] = depth[5:8] = np.nan
    lost = changed(t, replace(compass, heading=heading), replace(t.depth, depth=depth))
    motions = [filter_planar(x, "4sv-3ob")[0].trajectory for x in (t, lost)]
    for name in ("rph", "geodetic", "velocity"):
        np.testing.assert_allclose(*(getattr(m, name) for m in motions), atol=0.5)


def placed(t, east, north, std):
    """The trial with a start so far from the beacon, m."""
    place = InitialPosition(
        np.array([np.radians(25.0) + north / 6.37e6, np.radians(135.0) + east / 5.79e6, -40.0]),
        np.array([std, std, 1.0]),
    )
    return replace(t, initial_position=place)


def test_a_filter_that_went_to_a_mirror_image_has_not_converged(tmp_path, capsys):
    t = placed(trial(5, **STRAIGHT), 1.0, 1.0, 600.0)
    for method in ("4sv-2ob", "4sv-3ob"):
        solution, _ = filter_planar(t, method)
        assert not solution.converged
        assert of_code(solution.findings, Code.FILTER_CONTRADICTED)
    save_trial(t, tmp_path / "t")
    with pytest.raises(SystemExit) as exit_info:
        main(["kalman", str(tmp_path / "t"), "--out", str(tmp_path / "k"), "--no-figures"])
    assert exit_info.value.code == 1
    assert "not converged" in capsys.readouterr().err


# Heading away from the beacon, from beside it, and a turn.
AWAY = {
    "start": {
        "lat_deg": 25.0 + 50.0 / 110772.0,
        "lon_deg": 135.0 + 50.0 / 100950.0,
        "height_m": -40,
        "heading_deg": 45,
        "speed_m_s": 2,
    },
    "manoeuvres": [
        {"straight_s": 200},
        {"turn_deg_s": -3, "duration_s": 30},
        {"straight_s": 200},
    ],
}


@pytest.mark.parametrize("method", ["4sv-2ob", "4sv-3ob"])
def test_from_the_beacon_itself_a_vehicle_that_heads_away_is_found(method):
    t = trial(3, **AWAY)
    beacon = next(iter(t.required(Beacons).settings.positions.values()))
    start = t.frame().position(*beacon.geodetic)[:2]
    filtered = run_filter(t, method, start, np.full(2, 500.0))
    reference = t.reference
    true = t.frame().position(*interpolate(filtered.time, reference.time, reference.geodetic).T)
    error = np.hypot(*(filtered.state[:, :2] - true[:, :2]).T)
    assert error[-50:].max() < 20.0
    # A range rate before any displacement would make the position known to metres.
    assert np.sqrt(filtered.covariance[0, :2, :2].diagonal().max()) > 300.0


def test_a_filter_whose_innovations_contradict_it_has_not_converged():
    start = {"initial": {"position_std_m": [5, 5, 1]}}
    assert filter_planar(trial(5, trial=start), "4sv-3ob")[0].converged
    echoes = trial(5, trial=start, beacons={"multipath": 0.2})
    solution, _ = filter_planar(echoes, "4sv-3ob")
    assert not solution.converged
    (text,) = of_code(solution.findings, Code.FILTER_CONTRADICTED)
    assert text.startswith("Beacon range: ")


def test_a_few_large_innovations_are_chance():
    def seen(size, sigmas):
        z = np.full((size, 1), sigmas)
        return Residuals(
            "Beacon range", "m", ("range",), np.arange(float(size)), z, np.ones_like(z)
        )

    assert not contradictions([seen(2, 2.5), seen(100, 1.5), seen(100, 0.1), seen(0, 1.0)])
    assert len(contradictions([seen(100, 2.5)])) == 1
