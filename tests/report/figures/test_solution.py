from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from factorgraph_dvl.estimates import Estimate, Residuals, Trajectory
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.verdict import verdict_of
from factorgraph_dvl.report.figures.drawing import draw_band, save_figures
from factorgraph_dvl.report.figures.residuals import residuals_figure
from factorgraph_dvl.report.figures.solution import drawings, write_figures
from factorgraph_dvl.report.figures.trajectory import motion_figure, track_figure
from factorgraph_dvl.sensors.gnss import Gnss, GnssSettings
from factorgraph_dvl.sensors.imu import Imu, ImuSettings
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.trial import Reference, Trial

TRUTH = {
    "misalignment_deg": [1.8, 0.6, 30.0],
    "scale_error": [0.002],
    "lever_arm_m": [0.5, 1.2, -0.8],
    "gyro_bias_deg_h": [0.02, -0.01, 0.03],
    "accel_bias_ug": [50.0, -20.0, 10.0],
}
STD = {
    "misalignment_deg": [0.004, 0.006, 0.0015],
    "scale_error": [1.2e-5],
    "lever_arm_m": [0.004, 0.003, 0.02],
    "gyro_bias_deg_h": [0.01, 0.008, 0.015],
    "accel_bias_ug": [12.0, 9.0, 1.5],
}
PRIOR_STD = {
    "misalignment_deg": 180.0,
    "scale_error": 0.1,
    "lever_arm_m": 10.0,
    "gyro_bias_deg_h": 0.05,
    "accel_bias_ug": 100.0,
}


def component_names(name: str) -> tuple[str, ...]:
    if name == "scale_error":
        return (name,)
    for unit in ("_deg_h", "_deg", "_ug", "_m"):
        if name.endswith(unit):
            return tuple(f"{name.removesuffix(unit)}_{axis}{unit}" for axis in "xyz")
    raise ValueError(name)


def motion(frame: LocalFrame, t: np.ndarray) -> Reference:
    """Legs of a lawnmower with sway, as a reference."""
    heading = 0.5 * np.pi * (1.0 + np.tanh(4.0 * np.sin(2 * np.pi * t / 300.0))) + 0.1
    v_n = np.stack(
        [4.0 * np.sin(heading), 4.0 * np.cos(heading) + 0.6, 0.2 * np.sin(4 * np.pi * t / 5)], 1
    )
    p_n = np.concatenate(
        [np.zeros((1, 3)), np.cumsum(0.5 * (v_n[1:] + v_n[:-1]) * np.diff(t)[:, None], axis=0)]
    )
    rph = np.stack(
        [4 * DEG * np.sin(4 * np.pi * t / 5), 3 * DEG * np.cos(4 * np.pi * t / 5), heading], 1
    )
    return Reference(t, np.stack(frame.geodetic(p_n), 1), v_n, rph)


def diagonal(std: np.ndarray) -> np.ndarray:
    return std[:, :, None] ** 2 * np.eye(3)


def synthetic(
    duration: float, trajectory_step: int = 100, dvl_rate: float = 5.0, seed: int = 0
) -> tuple[Trial, Solution]:
    """Make a trial with a 100 Hz reference and a solution that scatters as it claims."""
    rng = np.random.default_rng(seed)
    frame = LocalFrame(36.0 * DEG, 122.0 * DEG, 10.0)
    t = np.arange(int(duration * 100) + 1) / 100.0
    reference = motion(frame, t)

    every = slice(None, None, trajectory_step)
    time = t[every]
    drift = 1.0 + np.cos(2 * np.pi * time / duration)[:, None]
    std = {
        "p": drift * [0.02, 0.02, 0.03] + 0.02,
        "v": drift * [0.001, 0.001, 0.002] + 0.001,
        "a": (drift * [0.001, 0.001, 0.004] + 0.002) * DEG,
    }
    slow = {k: np.sin(time[:, None] / 20.0 + [0.0, 1.0, 2.0]) for k in std}
    p_n = frame.position(*reference.geodetic[every].T) + slow["p"] * std["p"]
    trajectory = Trajectory(
        time=time,
        geodetic=np.stack(frame.geodetic(p_n), 1),
        velocity=reference.velocity[every] + slow["v"] * std["v"],
        rph=reference.rph[every] + slow["a"] * std["a"],
        position_cov=diagonal(std["p"]),
        velocity_cov=diagonal(std["v"]),
        rph_cov=diagonal(std["a"]),
    )

    estimates = []
    for name, value in TRUTH.items():
        sigma = np.array(STD[name])
        estimates.append(
            Estimate(
                name=name,
                component_names=component_names(name),
                value=np.array(value) + rng.standard_normal(sigma.size) * sigma,
                std=sigma,
                prior_value=np.zeros(sigma.size),
                prior_std=np.full(sigma.size, PRIOR_STD[name]),
                observable=2.0 * sigma < PRIOR_STD[name],
            )
        )
    sigmas = np.concatenate([e.std for e in estimates])
    root = rng.standard_normal((sigmas.size, 2 * sigmas.size))
    correlation = np.corrcoef(root)
    fixes = slice(None, None, 100)
    gnss_time = t[fixes]
    gnss_n = frame.position(*reference.geodetic[fixes].T)
    gnss_noise = rng.standard_normal((gnss_time.size, 3)) * [0.5, 0.5, 1.0]
    pings = np.arange(int(duration * dvl_rate)) / dvl_rate
    dvl_sigma = np.full((pings.size, 3), 0.008)
    residuals = (
        Residuals(
            "GNSS position",
            "m",
            ("east", "north", "up"),
            gnss_time,
            gnss_noise,
            np.full((gnss_time.size, 3), [0.5, 0.5, 1.0]),
        ),
        Residuals(
            "DVL velocity",
            "m/s",
            ("x", "y", "z"),
            pings,
            rng.standard_normal((pings.size, 3)) * dvl_sigma,
            dvl_sigma,
        ),
    )
    solution = Solution(
        trial="synthetic",
        solver="batch",
        body_axes="RFU",
        converged=True,
        iterations=5,
        cost=1.0,
        estimates=tuple(estimates),
        covariance=correlation * np.outer(sigmas, sigmas),
        trajectory=trajectory,
        residuals=residuals,
    )
    imu = Imu(
        settings=ImuSettings(
            gyro_noise_deg_sqrt_h=0.0005,
            gyro_bias_std_deg_h=0.05,
            accel_noise_ug_sqrt_hz=25.0,
            accel_bias_std_ug=100.0,
        ),
        time=t,
        gyro=np.zeros((t.size, 3)),
        accel=np.zeros((t.size, 3)),
    )
    nothing = np.full((gnss_time.size, 3), np.nan)
    gnss = Gnss(
        settings=GnssSettings(),
        time=gnss_time,
        geodetic=np.stack(frame.geodetic(gnss_n + gnss_noise), 1),
        velocity=nothing,
        position_std=nothing.copy(),
        velocity_std=nothing.copy(),
    )
    trial = Trial(
        name="synthetic",
        imu=imu,
        gnss=gnss,
        reference=reference,
        calibration_truth={k: np.array(v) for k, v in TRUTH.items()},
    )
    return trial, solution


def size_of(path: Path) -> tuple[int, int]:
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert len(data) > 5_000
    return struct.unpack(">II", data[16:24])  # type: ignore[return-value]


def drawn(
    trial: Trial, solution: Solution, folder: Path, *, alike: tuple[str, ...] = ()
) -> set[str]:
    """Draw all figures but those that look as in another test; return the names of all."""
    figures = drawings(solution, trial)
    assert set(alike) < set(figures)
    pictures = {name: draw(None) for name, draw in figures.items() if name not in alike}
    for path in save_figures(pictures, folder, solution.verdict, name=solution.trial):
        assert_size(path)
    return {f"{name}.png" for name in figures}


def assert_size(path: Path) -> None:
    width, height = size_of(path)
    assert 400 < width < 2200
    assert 200 < height < 2200


ALL = {
    "track.png",
    "motion.png",
    "gnss_residuals.png",
    "dvl_residuals.png",
    "calibration.png",
    "correlation.png",
}


UNCALIBRATED = ALL - {"calibration.png", "correlation.png"}
RESIDUALS = ("gnss_residuals", "dvl_residuals")


def without_calibration(solution: Solution) -> Solution:
    return replace(solution, estimates=(), covariance=np.zeros((0, 0)))


# A division by zero or a nan on its way to a figure warns, and fails here.
pytestmark = pytest.mark.filterwarnings("error")


@pytest.fixture(scope="module")
def short() -> tuple[Trial, Solution]:
    return synthetic(60.0, trajectory_step=20)


def test_all_figures(short: tuple[Trial, Solution], tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    paths = write_figures(*short, folder)
    assert sorted(folder.iterdir()) == sorted(paths)
    for path in paths:
        assert_size(path)
    assert {path.name for path in paths} == ALL


def test_without_reference_and_truth(short: tuple[Trial, Solution], tmp_path: Path) -> None:
    trial, solution = short
    bare = replace(trial, reference=None, calibration_truth={}, gnss=None)
    assert drawn(bare, solution, tmp_path, alike=(*RESIDUALS, "correlation")) == ALL


def test_reference_at_other_times(short: tuple[Trial, Solution], tmp_path: Path) -> None:
    trial, solution = short
    assert trial.reference is not None
    later = replace(trial.reference, time=trial.reference.time + 1000.0)
    motion_only = without_calibration(replace(solution, residuals=()))
    drawn_files = drawn(replace(trial, reference=later), motion_only, tmp_path)
    assert drawn_files == {"track.png", "motion.png"}


def test_large_clock_readings(short: tuple[Trial, Solution], tmp_path: Path) -> None:
    trial, solution = short
    moved = replace(
        without_calibration(solution),
        trajectory=replace(solution.trajectory, time=solution.trajectory.time + 1.7e9),
        residuals=tuple(replace(r, time=r.time + 1.7e9) for r in solution.residuals),
    )
    assert drawn(replace(trial, reference=None), moved, tmp_path) == UNCALIBRATED


def test_unobservable_and_fixed_components(short: tuple[Trial, Solution], tmp_path: Path) -> None:
    trial, solution = short
    first, *rest = solution.estimates
    std = np.array([0.004, 175.0, 0.0])
    odd = replace(
        first,
        value=np.array([-179.9, 0.35, 0.0]),
        std=std,
        prior_std=np.array([180.0, 180.0, 0.0]),
        observable=np.array([True, False, False]),
    )
    stds = np.concatenate([std, *(e.std for e in rest)])
    changed = replace(solution, estimates=(odd, *rest), covariance=np.diag(stds**2), residuals=())
    expected = ALL - {"gnss_residuals.png", "dvl_residuals.png"}
    bare = replace(trial, reference=None)
    assert drawn(bare, changed, tmp_path, alike=("track", "motion")) == expected


def test_nothing_estimated_and_no_residuals(short: tuple[Trial, Solution]) -> None:
    trial, solution = short
    bare = without_calibration(replace(solution, residuals=()))
    assert set(drawings(bare, trial)) == {"track", "motion"}


def test_outliers_and_vehicle_at_rest(short: tuple[Trial, Solution], tmp_path: Path) -> None:
    trial, solution = short
    gnss, dvl = solution.residuals
    residual = dvl.residual.copy()
    residual[5] = 1e3
    tr = solution.trajectory
    still = replace(
        tr,
        geodetic=np.broadcast_to(tr.geodetic[0], tr.geodetic.shape),
        velocity=np.zeros_like(tr.velocity),
        rph=np.zeros_like(tr.rph),
    )
    changed = replace(
        without_calibration(solution),
        trajectory=still,
        residuals=(gnss, replace(dvl, residual=residual)),
    )
    bare = replace(trial, reference=None)
    assert drawn(bare, changed, tmp_path, alike=("gnss_residuals",)) == UNCALIBRATED


def titles(figure: Figure) -> list[str]:
    return [title for ax in figure.axes if (title := ax.get_title(loc="left"))]


def test_what_nobody_measured_is_not_drawn(short: tuple[Trial, Solution]) -> None:
    track = short[1].trajectory
    rph, cov = track.rph.copy(), track.rph_cov.copy()
    rph[:, :2], cov[:, :2, :2] = 0.0, np.nan
    labels = [
        a.get_ylabel() for a in motion_figure(replace(track, rph=rph, rph_cov=cov), None).axes
    ]
    assert "heading, deg" in labels
    assert not {"roll, deg", "pitch, deg"} & set(labels)


def test_a_swing_too_fast_for_the_whole_time_is_drawn_close_up(
    short: tuple[Trial, Solution], tmp_path: Path
) -> None:
    trajectory = short[1].trajectory
    assert len(motion_figure(trajectory, None).axes) == 12
    _, solution = synthetic(900.0, trajectory_step=10)
    figure = motion_figure(solution.trajectory, None)
    assert len(figure.axes) == 18
    assert "10 s of it" in titles(figure)
    close_up = figure.axes[2]
    (line,) = close_up.lines
    seconds, roll = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
    assert seconds[0] == pytest.approx(445.0)
    assert seconds[-1] == pytest.approx(455.0)
    shown = np.isin(solution.trajectory.time, seconds)
    np.testing.assert_allclose(roll, solution.trajectory.rph[shown, 0] / DEG)
    (path,) = save_figures({"motion": figure}, tmp_path, solution.verdict)
    assert_size(path)


def test_residuals_are_drawn_in_their_own_sigma(short: tuple[Trial, Solution]) -> None:
    _, dvl = short[1].residuals
    # A residual of 4 of its own σ beside one whose σ is ten times as large.
    residual, sigma = dvl.residual.copy(), dvl.sigma.copy()
    sigma[8] *= 10.0
    residual[7] = 4.0 * sigma[7]
    figure = residuals_figure([replace(dvl, residual=residual, sigma=sigma)])
    left = figure.axes[0]
    drawn_points = np.concatenate([np.asarray(line.get_ydata()) for line in left.lines])
    assert np.abs(drawn_points).max() == pytest.approx(4.0)
    (band,) = left.patches
    assert np.ptp(band.get_window_extent().intervaly) > 0.0
    low, high = np.sort(left.transData.inverted().transform(band.get_window_extent())[:, 1])
    assert (low, high) == pytest.approx((-3.0, 3.0))
    assert any("σ from 0.008 to 0.08 m/s" in text.get_text() for text in left.texts)


def test_residuals_beyond_the_panel_are_triangles_with_a_count(
    short: tuple[Trial, Solution],
) -> None:
    _, dvl = short[1].residuals
    residual = dvl.residual.copy()
    residual[[3, 9], 0] = 50.0 * dvl.sigma[[3, 9], 0]
    residual[20, 0] = -8.0 * dvl.sigma[20, 0]
    left, right = residuals_figure([replace(dvl, residual=residual)]).axes[:2]
    count = {line.get_marker(): np.size(line.get_xdata()) for line in left.lines}
    assert (count["^"], count["v"]) == (2, 1)
    said = [text.get_text() for text in left.texts]
    assert "2 beyond the panel, up to 50 σ" in said
    assert "1 beyond the panel, up to 8 σ" in said
    # They are not put into the last bins, where they would look like many.
    (bars,) = right.patches
    values, edges, _ = bars.get_data()
    share = float(values @ np.diff(edges))
    assert share == pytest.approx(1.0 - 3.0 / dvl.time.size)
    assert values[0] == 0.0
    assert values[-1] == 0.0


def test_a_swing_is_no_rectangle_and_a_band_that_is_not_seen_is_not_named() -> None:
    _, solution = synthetic(900.0, trajectory_step=10)
    track = solution.trajectory
    left = motion_figure(track, None).axes[0]
    assert left.get_ylabel() == "roll, deg"
    assert not [c for c in left.collections if c.get_paths()]
    low, high, mean = (np.asarray(line.get_ydata()) for line in left.lines[:3])
    assert (low <= mean).all()
    assert (mean <= high).all()
    assert np.ptp(mean) < 0.6 * np.ptp(track.rph[:, 0] / DEG)
    assert "largest in" in left.texts[0].get_text()
    tight = replace(track, velocity_cov=1e-8 * track.velocity_cov, rph_cov=1e-8 * track.rph_cov)
    assert titles(motion_figure(tight, None))[0] == "Attitude and velocity"


def test_the_band_of_errors_is_nowhere_wider_than_a_neighbours_sigma() -> None:
    figure = Figure()
    ax = figure.add_subplot()
    half = np.where(np.arange(10_000) % 10 == 0, 5.0, 1.0)
    draw_band(ax, np.arange(10_000.0), half)
    for line in ax.lines:
        assert np.abs(np.asarray(line.get_ydata())).max() == 1.0


def test_sensors_get_files_of_their_own(short: tuple[Trial, Solution], tmp_path: Path) -> None:
    trial, solution = short
    t = np.arange(50.0)
    depth = Residuals(
        "Depth", "m", ("down",), t, 0.1 * np.sin(t)[:, None], np.full((t.size, 1), 0.1)
    )
    changed = replace(without_calibration(solution), residuals=(*solution.residuals, depth))
    alike = ("track", "motion", *RESIDUALS)
    assert drawn(trial, changed, tmp_path, alike=alike) == UNCALIBRATED | {"depth_residuals.png"}


def test_lines_of_a_long_trial_are_drawn_with_few_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn_points: list[int] = []

    def keep(figures: dict[str, Figure], folder: Path, *_: object, **__: object) -> list[Path]:
        for figure in figures.values():
            lines = [line for axes in figure.axes for line in axes.get_lines()]
            drawn_points.extend(np.size(line.get_xdata()) for line in lines)
        return []

    monkeypatch.setattr("factorgraph_dvl.report.figures.solution.save_figures", keep)
    trial, solution = synthetic(4800.0, trajectory_step=4)
    assert solution.trajectory.time.size > 100_000
    write_figures(trial, solution, tmp_path)
    assert 1000 < max(drawn_points) < 25_000


@pytest.mark.parametrize(("kind", "start"), [("svg", b"<?xml"), ("pdf", b"%PDF-")])
def test_vector_figures_lie_beside_and_are_the_same_again(
    tmp_path: Path, kind: str, start: bytes
) -> None:
    written = []
    for name in ("a", "b"):
        figure = Figure()
        figure.add_subplot().plot([0.0, 1.0], [0.0, 1.0])
        paths = save_figures({name: figure}, tmp_path, kind=kind)
        assert [path.name for path in paths] == [f"{name}.png", f"{name}.{kind}"]
        written.append(paths[1].read_bytes())
    assert written[0] == written[1]
    assert written[0].startswith(start)


def test_a_figure_bears_its_trial_its_verdict_and_the_reasons(tmp_path: Path) -> None:
    codes = (Code.CLOCK_OFFSET, Code.CLOCK_JUMP, Code.IMU_NOISE, Code.CLOCK_STEP)
    findings = tuple(Finding(code, "so it is", severity="warning") for code in codes)
    verdict = verdict_of(findings)
    figure = Figure()
    save_figures({"empty": figure}, tmp_path, verdict, name="a trial")
    texts = [text.get_text() for text in figure.texts]
    first = ", ".join(reason.code for reason in verdict.reasons[:3])
    assert texts == [f"doubtful: {first} and 1 more", "a trial"]


def test_a_track_has_marks_of_time() -> None:
    trial, solution = synthetic(60.0)
    figure = track_figure(trial, solution.trajectory, None)
    texts = {text.get_text() for text in figure.axes[0].texts}
    assert {"10 s", "20 s", "50 s"} <= texts
    assert figure.axes[0].get_title("right") == "N ↑"


@pytest.mark.parametrize("name", ["track", "motion", "dvl_residuals", "calibration"])
def test_verdict_and_name_keep_clear_of_all_other_text(name: str, tmp_path: Path) -> None:
    trial, solution = synthetic(60.0)
    figure = drawings(solution, trial)[name](None)
    codes = (Code.SMALL_RESIDUALS, Code.OUTLIERS, Code.UNCERTAIN)
    verdict = verdict_of([Finding(code, "so it is", severity="warning") for code in codes])
    save_figures({name: figure}, tmp_path, verdict, name="a trial")
    renderer = FigureCanvasAgg(cast(Figure, figure)).get_renderer()
    own = figure.texts[-2:]
    others = [
        text
        for text in figure.findobj(Text)
        if isinstance(text, Text) and text not in own and text.get_visible() and text.get_text()
    ]
    assert len(others) > 5
    for label in own:
        place = label.get_window_extent(renderer)
        assert not [t.get_text() for t in others if place.overlaps(t.get_window_extent(renderer))]
