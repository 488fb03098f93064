"""A solution shows itself: as text, HTML, tables and figures, loaded or fresh."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import factorgraph_dvl as fd
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.quality.results import consistency_findings

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ["track", "motion", "dvl_residuals", "calibration", "correlation"]


@pytest.fixture(scope="module")
def trial():
    return fd.simulate(ROOT / "examples" / "short.yaml", seed=1)


@pytest.fixture(scope="module")
def solution(trial):
    return fd.solve(trial)


@pytest.fixture(scope="module")
def loaded(solution, tmp_path_factory):
    folder = tmp_path_factory.mktemp("solution") / "out"
    fd.save_solution(solution, folder)
    return fd.load_solution(folder)


def test_representations_are_short(trial, solution):
    assert repr(solution) == "<Solution of 'short run' by batch: good, 9 parameters>"
    assert repr(solution.trajectory).startswith("<Trajectory of 86")
    assert repr(trial) == "<Trial 'short run': imu 4300, gnss 172, dvl 172>"


def test_a_solution_goes_to_another_process_and_back(solution):
    again = pickle.loads(pickle.dumps(solution))
    assert again.summary() == solution.summary()


def test_summary_and_html_have_every_component(solution):
    for text in (solution.summary(), solution._repr_html_()):
        assert text.splitlines()[0].count("short run") == 1
        assert "good" in text
        for name in ("misalignment_z", "scale_error", "lever_arm_x", "dvl_bias_z"):
            assert name in text
        assert "19.998 ± 0.021" in text
    assert max(map(len, solution.summary().splitlines())) <= 80


def test_html_is_escaped(solution):
    from dataclasses import replace

    assert "<script>" not in replace(solution, trial="<script>")._repr_html_()


def test_data_frames(solution, loaded):
    pytest.importorskip("pandas")
    for each in (solution, loaded):
        calibration = fd.to_dataframe(each)
        assert list(calibration.index) == list(each.order)
        assert calibration.loc["scale_error", "std"] == each.estimate("scale_error").std[0]
        assert set(calibration["grade"]) <= {"green", "orange", "red", "grey"}
        motion = fd.to_dataframe(each, "trajectory")
        np.testing.assert_allclose(motion["heading_deg"], np.degrees(each.trajectory.rph[:, 2]))
        residuals = fd.to_dataframe(each, "residuals")
        assert len(residuals) == sum(r.residual.size for r in each.residuals)
    with pytest.raises(ConfigError, match="table is 'poses'"):
        fd.to_dataframe(solution, "poses")


def test_xarray_dataset(solution):
    pytest.importorskip("xarray", reason="xarray is not installed")
    data = fd.to_xarray(solution)
    name = "misalignment_z_deg"
    variance = data["covariance"].sel(component=name, other_component=name)
    assert float(variance) == pytest.approx(float(data["std"].sel(component=name)) ** 2)
    assert data["lat_deg"].dims == ("time_s",)
    assert data.attrs["verdict"] == "good"


def test_a_missing_library_names_its_extra(solution, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pandas", None)
    with pytest.raises(ConfigError, match=r"pandas is not installed.*notebook"):
        fd.to_dataframe(solution)


@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_is_drawn_in_the_place_of_axes(loaded, name):
    figure = Figure(figsize=(12.0, 8.0))
    axes = figure.subplots(2, 2)
    kept = [axes[0, 0], axes[0, 1], axes[1, 0]]
    box = axes[1, 1].get_position()
    part = fd.plot(loaded, name, axes=axes[1, 1])
    assert part in figure.subfigs
    assert figure.axes[:3] == kept
    figure.draw_without_rendering()
    panels = part.axes
    assert panels
    for panel in panels:
        inside = panel.get_window_extent().transformed(figure.transFigure.inverted())
        assert inside.x0 >= box.x0 - 0.02
        assert inside.x1 <= box.x1 + 0.02
        assert inside.y0 >= box.y0 - 0.02
        assert inside.y1 <= box.y1 + 0.02
        assert inside.width > 0.002


def test_a_new_figure_may_show_the_truth(solution, trial):
    fresh = fd.plot(solution, trial=trial)
    assert isinstance(fresh, Figure)
    assert "truth" in [text.get_text() for text in fresh.legends[0].get_texts()]


def test_axes_without_a_grid_have_a_place(loaded):
    figure = Figure()
    axes = figure.add_axes((0.5, 0.5, 0.4, 0.4))
    part = fd.plot(loaded, "correlation", axes=axes)
    np.testing.assert_allclose(part.bbox.x0 / figure.bbox.width, 0.5)


def test_an_unknown_figure_is_refused(solution):
    with pytest.raises(ConfigError, match=r"no figure 'poses'.*one of track, motion"):
        fd.plot(solution, "poses")


@pytest.mark.parametrize(("value", "std", "stated", "refused"), [
    (0.29, 0.02, 0.0, True),
    (-0.20, 0.02, 0.0, True),
    (0.29, 0.10, 0.0, False),
    (0.06, 0.01, 0.0, False),
    (0.29, 0.02, 0.3, False),
])  # fmt: skip
def test_a_scale_error_that_no_log_has_is_not_to_be_used(solution, value, std, stated, refused):
    scale = replace(
        solution.estimate("scale_error"),
        value=np.array([value]),
        std=np.array([std]),
        prior_value=np.array([stated]),
    )
    found = consistency_findings([scale], [])
    assert [f.severity for f in found if f.code == Code.IMPOSSIBLE_SCALE] == ["error"] * refused


@pytest.mark.parametrize(("value", "cause"), [
    (np.sin(np.deg2rad(20)) / np.sin(np.deg2rad(30)) - 1, "look 20 deg from the vertical, and 30"),
    (np.sin(np.deg2rad(25)) / np.sin(np.deg2rad(30)) - 1, "look 25 deg from the vertical, and 30"),
    (-2.02, "the sign is reversed"),
    (-1.2, "a current, a bed that moves, a false bottom lock, a wrong unit or another error"),
])  # fmt: skip
def test_a_scale_error_names_its_cause(solution, value, cause):
    scale = replace(
        solution.estimate("scale_error"), value=np.array([value]), std=np.array([0.01])
    )
    found = consistency_findings([scale], [])
    (text,) = (f.text for f in found if f.code == Code.IMPOSSIBLE_SCALE)
    assert cause in text
