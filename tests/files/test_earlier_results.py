"""Results of an earlier version: a solution folder of a trial without IMU that it wrote."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from running import run  # noqa: F401

from factorgraph_dvl.campaign.record import RunRecord
from factorgraph_dvl.campaign.trials import assembled
from factorgraph_dvl.files.calibration_file import load_calibration
from factorgraph_dvl.files.solution_folder import load_solution, read_history
from factorgraph_dvl.quality.finding import Code

# Of 70 s of `configs/ship-water.yaml`, by the smoother of trials without IMU before they were on
# the graph (commit 77d8f00): `solve ship --no-figures --rate 0.2`.
RESULT = Path(__file__).parents[1] / "data" / "result-without-imu"


@pytest.fixture
def folder(tmp_path):
    return shutil.copytree(RESULT, tmp_path / "trials" / "ship")


def test_a_result_is_loaded_whole(folder):
    solution = load_solution(folder)
    assert solution.converged
    assert solution.estimate("scale_error").value == pytest.approx(-0.0083, abs=1e-4)
    assert solution.estimate("current_m_s").std == pytest.approx([0.022, 0.020], abs=1e-3)
    assert [r.label for r in solution.residuals] == ["GNSS position", "DVL velocity"]
    assert [len(r.time) for r in solution.rejected] == [4]
    assert solution.trajectory.time.size > 10
    assert Code.HEADING_ERROR in {f.code for f in solution.findings}
    causes = {c.cause for c in solution.error_budget}
    assert {"how much the current carries the vessel", "changes of the current"} <= causes
    total = np.sum([c.adds**2 for c in solution.error_budget], axis=0)
    np.testing.assert_allclose(total, np.diag(solution.covariance), rtol=1e-3)
    time, names, _ = read_history(folder)
    assert time.size > 10
    assert set(names) <= set(solution.order)


def test_its_page_is_made_anew_and_compared(folder, run):  # noqa: F811
    assert run("report", folder).code == 0
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "how much the current carries the vessel" in page
    assert "海流带动船的程度" in page
    again = shutil.copytree(folder, folder.with_name("again"))
    assert run("report", folder, again, "--out", folder.parent / "both.html").code == 0


def test_a_campaign_takes_it(folder):
    record = RunRecord(name="ship", fingerprint="x", done=True)
    out = folder.parents[1]
    found = assembled([out / "ship"], ["ship"], [record], out, anyway=True)
    (trial,) = found.used
    alone = load_calibration(folder)
    assert trial.calibration.order == alone.order
    assert found.joint is not None
