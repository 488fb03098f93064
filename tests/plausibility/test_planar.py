"""What is implausible about planar trials."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planar import BASE, changed, trial, without
from truth import merged

from factorgraph_dvl.cli import main
from factorgraph_dvl.files.trial_folder import save_trial
from factorgraph_dvl.plausibility.survey import survey
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import parse_scenario, simulate


def test_implausible_records_are_named():
    t = trial()
    heading, log, depth, _ = t.records
    assert not survey(t).problems
    place = {"B1": {"lat_deg": 25.0, "lon_deg": 135.0, "height_m": 80}}
    above = simulate(parse_scenario(merged(BASE, {"beacons": {"positions": place}})), 0)
    for wrong, label, says in (
        (changed(t, without(heading, 140, 180)), "Heading", "1 gap from 140 to 180 s"),
        (changed(t, without(log, 20, 50)), "Log", "1 gap from 20 to 50 s"),
        (
            changed(t, replace(heading, heading=heading.heading * np.pi / 180)),
            "Heading",
            "radians",
        ),
        (changed(t, replace(log, speed=-log.speed)), "Log", "astern"),
        (changed(t, replace(log, speed=0.0 * log.speed)), "Log", "a circle"),
        (changed(t, replace(depth, depth=-depth.depth)), "Depth", "positive down"),
        (above, "Beacon", "B1 is 80 m above the sea surface"),
    ):
        (found,) = survey(wrong).problems
        assert found.sensor == label
        assert says in found.text


def test_a_gap_is_no_secret():
    t = trial()
    (found,) = survey(changed(t, without(t.records[0], 140, 180))).problems
    assert (found.sensor, found.code) == ("Heading", Code.GAPS)
    assert found.text.startswith("1 gap from 140 to 180 s")


def test_inspect_knows_planar_trials(tmp_path, capsys):
    t = trial()
    save_trial(changed(t, without(t.records[0], 140, 180)), tmp_path / "t")
    with pytest.raises(SystemExit) as exit_info:
        main(["inspect", str(tmp_path / "t")])
    out = capsys.readouterr().out
    assert exit_info.value.code == 0
    for text in ("Heading", "Log", "Depth", "Beacon", "speed 1.", "warning: Heading: 1 gap"):
        assert text in out
    late = changed(t, replace(t.beacons, time=t.beacons.time + 1e5))
    for in_order in (late, replace(late, others=late.others[::-1])):
        (finding,) = survey(in_order).problems
        assert (finding.severity, finding.code) == ("error", Code.NO_OVERLAP)
    heading = t.records[0]
    apart = changed(t, replace(heading, time=heading.time + 1e5))
    (finding,) = survey(apart).problems
    assert (finding.sensor, finding.code) == ("Heading", Code.NO_OVERLAP)
