"""What is implausible about planar trials."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planar import BASE, trial, without
from truth import merged

from factorgraph_dvl.cli import main
from factorgraph_dvl.io.planar_folder import save_planar_trial
from factorgraph_dvl.quality.plausibility_planar import planar_findings
from factorgraph_dvl.quality.survey_planar import survey_planar
from factorgraph_dvl.sensors.finding import Code
from factorgraph_dvl.simulation import parse_scenario, simulate_planar


def test_implausible_records_are_named():
    t = trial()
    assert not list(planar_findings(t))
    place = {"B1": {"lat_deg": 25.0, "lon_deg": 135.0, "height_m": 80}}
    above = simulate_planar(parse_scenario(merged(BASE, {"beacons": {"positions": place}})), 0)
    for wrong, label, says in (
        (replace(t, heading=without(t.heading, 140, 180)), "Heading", "1 gap from 140 to 180 s"),
        (replace(t, log=without(t.log, 20, 50)), "Log", "1 gap from 20 to 50 s"),
        (
            replace(t, heading=replace(t.heading, heading=t.heading.heading * np.pi / 180)),
            "Heading",
            "radians",
        ),
        (replace(t, log=replace(t.log, speed=-t.log.speed)), "Log", "astern"),
        (replace(t, log=replace(t.log, speed=0.0 * t.log.speed)), "Log", "a circle"),
        (replace(t, depth=replace(t.depth, depth=-t.depth.depth)), "Depth", "positive down"),
        (above, "Beacon", "B1 is 80 m above the sea surface"),
    ):
        (found,) = planar_findings(wrong)
        assert found.sensor == label
        assert says in found.text


def test_a_gap_is_no_secret():
    t = trial()
    (found,) = planar_findings(replace(t, heading=without(t.heading, 140, 180)))
    assert (found.sensor, found.code) == ("Heading", Code.GAPS)
    assert found.text.startswith("1 gap from 140 to 180 s")


def test_inspect_knows_planar_trials(tmp_path, capsys):
    t = trial()
    save_planar_trial(replace(t, heading=without(t.heading, 140, 180)), tmp_path / "t")
    with pytest.raises(SystemExit) as exit_info:
        main(["inspect", str(tmp_path / "t")])
    out = capsys.readouterr().out
    assert exit_info.value.code == 0
    for text in ("Heading", "Log", "Depth", "Beacon", "speed 1.", "warning: Heading: 1 gap"):
        assert text in out
    late = replace(t, beacons=replace(t.beacons, time=t.beacons.time + 1e5))
    (finding,) = survey_planar(late).problems
    assert (finding.severity, finding.code) == ("error", Code.NO_OVERLAP)
