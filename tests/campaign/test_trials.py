"""Trials to a campaign: files, page, and the joint calibration against a chain of priors."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pyarrow.parquet
import pytest
from truth import scenario

from factorgraph_dvl import save_solution, simulate, solve
from factorgraph_dvl.campaign.files import write_campaign
from factorgraph_dvl.campaign.page import write_page
from factorgraph_dvl.campaign.record import RunRecord, fingerprint_of, read_record, write_record
from factorgraph_dvl.campaign.tables import joint_table, trials_table
from factorgraph_dvl.campaign.trials import assembled, labels_of, read_covariates
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.calibration_file import load_calibration
from factorgraph_dvl.files.earlier_calibration import calibrated_by
from factorgraph_dvl.report.table import plain


def dive(number):
    data = scenario(noise=True, name=f"dive {number}", epoch=f"2024-05-0{9 - number}T00:00:00Z")
    # Noise that each trial estimates for itself would differ from that of a chain.
    return replace(simulate(data, number), noise="stated")


def record_of(trial):
    return RunRecord(name=trial.name, fingerprint="x", done=True, epoch=trial.epoch, wall_s=2.0)


@pytest.fixture(scope="module")
def solved():
    """Two trials, and what is found of each; the second was earlier."""
    trials = [dive(1), dive(2)]
    return trials, [solve(trial) for trial in trials]


@pytest.fixture(scope="module")
def campaign(solved, tmp_path_factory):
    """A campaign of them, and of a third that failed."""
    out = tmp_path_factory.mktemp("campaign")
    trials, solutions = solved
    for label, solution in zip("ab", solutions, strict=True):
        save_solution(solution, out / "trials" / label)
    (out / "trials" / "a" / "report.html").write_text("its own")
    failed = RunRecord(name="<b>", fingerprint="", done=False, error="a <table> is missing")
    records = [*map(record_of, trials), replace_epoch(failed, "2024-05-01")]
    found = assembled([out / "1", out / "2", out / "3"], "abc", records, out)
    write_campaign(found, out)
    write_page(found, out)
    return found, out


def replace_epoch(record, epoch):
    record.epoch = epoch
    return record


def test_joint_calibration_is_that_of_a_chain_of_priors(solved, campaign, tmp_path):
    """The calibration of one trial as the prior of the next, other parameters of the day.

    What is not linear shows in the order of the chain: the joint calibration has none.
    """
    joint = campaign[0].joint
    names = joint.information.names
    value, covariance = joint.shared.value_in(-1)
    std = np.sqrt(np.diag(covariance))
    off = []
    for first, second in ((0, 1), (1, 0)):
        chain = chained(solved, first, second, tmp_path / f"{first}")
        at = [chain.order.index(n) for n in names]
        theirs = np.concatenate([e.value for e in chain.estimates])[at]
        off.append((theirs - value) / std)
        np.testing.assert_allclose(np.sqrt(np.diag(chain.covariance))[at] / std, 1.0, atol=0.01)
    assert np.all(np.max(np.abs(off), axis=0) < np.abs(off[0] - off[1]) + 0.02)
    assert np.max(np.abs(np.mean(off, axis=0))) < 0.1


def chained(solved, first, second, folder):
    """Return the solution of a trial whose prior is the calibration of another."""
    trials, solutions = solved
    save_solution(solutions[first], folder)
    trial = trials[second]
    earlier = load_calibration(folder)
    dvl = calibrated_by(trial.dvl, earlier, trial.body_axes, "first")
    return solve(replace(trial, dvl=dvl))


def test_campaign_json_is_as_the_format_says(campaign):
    _, out = campaign
    content = json.loads((out / "campaign.json").read_text())
    assert content["format"] == 1
    assert [t["name"] for t in content["trials"]] == ["<b>", "dive 2", "dive 1"]
    assert [t["used"] for t in content["trials"]] == [False, True, True]
    order = content["joint"]["covariance"]["order"]
    assert order[:4] == [*(f"misalignment_{a}_deg" for a in "xyz"), "scale_error"]
    matrix = np.array(content["joint"]["covariance"]["matrix"])
    parameters = content["joint"]["parameters"]
    std = np.concatenate([p["std"] for p in parameters.values()])
    np.testing.assert_allclose(np.sqrt(np.diag(matrix)), std)
    assert set(content["between_trials_std"]) == set(order)
    assert content["changes"] == []
    truth = [2.0, 2.0, 30.0, 0.005, 1.0, 1.2, 1.4]
    value = np.concatenate([p["value"] for p in parameters.values()])
    assert np.all(abs(value - truth) < 4.0 * std)


def test_trials_parquet_has_a_row_for_each_trial(campaign):
    table = pyarrow.parquet.read_table(campaign[1] / "trials.parquet").to_pydict()
    assert table["trial"] == ["<b>", "dive 2", "dive 1"]
    assert table["scale_error"][0] is None
    assert abs(table["misalignment_z_deg"][1] - 30.0) < 1.0


def test_the_calibration_for_the_next_trial_contains_variation_between_trials(campaign):
    found, out = campaign
    calibration = load_calibration(out)
    expected = np.diag(found.joint.covariance) + found.joint.between_std**2
    np.testing.assert_allclose(np.diag(calibration.covariance), expected)
    assert set(calibration.inputs) == {i for t in found.used for i in t.calibration.inputs}


def test_the_tables_have_units_and_trials_by_verdict(campaign):
    found, _ = campaign
    table = joint_table(found, found.joint)
    rows = {plain(row[0]): [plain(cell) for cell in row[1:]] for row in table.rows}
    assert [c.header for c in table.columns] == [
        "parameter", "value ± σ", "unit", "between trials", "grade",
    ]  # fmt: skip
    value, unit, _, grade = rows["lever_arm_y"]
    assert abs(float(value.partition(" ±")[0]) - 1.2) < 0.1
    assert unit == "m"
    assert grade == "green"
    by_verdict = {plain(row[0]): row[1:] for row in trials_table(found).rows}
    assert by_verdict["not solved"] == ("1", "c")
    solved = [t for t in found.trials if t.calibration]
    assert sum(int(n) for v, (n, _) in by_verdict.items() if v != "not solved") == len(solved)


def test_the_page_is_whole_and_leads_to_the_results(campaign):
    _, out = campaign
    text = (out / "report.html").read_text()
    opened, links = [], []

    class Page(HTMLParser):
        def handle_starttag(self, tag, attrs):
            if tag not in ("meta", "line", "circle", "polygon", "polyline"):
                opened.append(tag)
            links.extend(value for name, value in attrs if name == "href")

        def handle_endtag(self, tag):
            assert opened.pop() == tag

    Page().feed(re.sub(r"<(line|circle|polygon|polyline)([^>]*)/>", r"<\1\2>", text))
    assert not opened
    links = {link for link in links if not link.startswith("#")}
    assert {"trials/a/report.html", "trials/b/calibration.json"} == links
    assert all((out / link).exists() for link in links)
    assert "a &lt;table&gt; is missing" in text
    assert "lever arm starboard" in text
    shown = text[text.index("<main") : text.index("</main>")]
    assert "nan" not in shown
    headings = re.findall(r"<h[123][^>]*>(.*?)</h[123]>", shown)
    assert headings
    assert all("zh-Hans" in heading for heading in headings)
    assert "次试验的联合标定" in text


def test_labels_are_folders_of_their_own(tmp_path):
    for name in ("a/dive", "b/dive", "c/dive-2", "d/. e"):
        (tmp_path / name).mkdir(parents=True)
    paths = [tmp_path / n for n in ("a/dive", "b/dive", "c/dive-2", "d/. e")]
    assert labels_of(paths) == ["dive", "dive-2", "dive-2-2", "-e"]


def test_fingerprints_know_content_and_options_and_records_survive(tmp_path):
    file = tmp_path / "imu.csv"
    file.write_text("1")
    first = fingerprint_of([file], {"options": ""})
    assert first == fingerprint_of([file], {"options": ""})
    assert first != fingerprint_of([file], {"options": "--no-figures"})
    file.write_text("2")
    assert first != fingerprint_of([file], {"options": ""})
    record = RunRecord(name="a", fingerprint=first, done=True, prior_names=["x"])
    write_record(record, tmp_path / "new" / "a.json")
    assert read_record(tmp_path / "new" / "a.json", RunRecord) == record
    (tmp_path / "new" / "a.json").write_text('{"name": "a"')
    assert read_record(tmp_path / "new" / "a.json", RunRecord) is None
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.json"]


def test_covariates_name_file_and_line(tmp_path, campaign):
    file = tmp_path / "t.csv"
    file.write_text("trial,temperature_deg_c\ndive 1,12.5\ndive 2,14\n")
    assert read_covariates(file) == {"temperature_deg_c": {"dive 1": 12.5, "dive 2": 14.0}}
    file.write_text("trial,temperature_deg_c\ndive 1,warm\n")
    with pytest.raises(DataError, match=r"t\.csv line 2: temperature_deg_c is 'warm'"):
        read_covariates(file)
    file.write_text("dive,temperature_deg_c\ndive 1,2\n")
    with pytest.raises(DataError, match="a column `trial`"):
        read_covariates(file)
    found, out = campaign
    records = [t.record for t in found.used]
    with pytest.raises(ConfigError, match="no value for the trial dive 1"):
        assembled([out] * 2, "ba", records, out, covariates={"t": {"dive 2": 1.0}})


def test_the_joint_calibration_of_one_trial_is_its_own(campaign):
    found, out = campaign
    (trial,) = [t for t in found.used if t.name == "dive 1"]
    alone = assembled([out], [trial.label], [trial.record], out)
    own = trial.calibration.estimates
    values = {n: v for e in own for n, v in zip(e.component_names, e.value, strict=True)}
    stds = {n: v for e in own for n, v in zip(e.component_names, e.std, strict=True)}
    names = alone.joint.information.names
    assert alone.joint.value == pytest.approx([values[n] for n in names], rel=1e-6)
    std = np.sqrt(np.diag(alone.joint.covariance))
    assert std == pytest.approx([stds[n] for n in names], rel=1e-4)
    assert not alone.joint.between_std.any()


def test_trials_without_a_result_leave_the_joint_calibration_to_others(tmp_path):
    failed = RunRecord(name="a", fingerprint="", done=False, error="no IMU")
    found = assembled([tmp_path], ["a"], [failed], tmp_path)
    assert found.joint is None
    assert found.trials[0].unused == "no IMU"
    write_campaign(found, tmp_path)
    write_page(found, tmp_path)
    assert json.loads((tmp_path / "campaign.json").read_text())["joint"] is None
