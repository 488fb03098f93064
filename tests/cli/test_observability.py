"""The command `observability`: what it writes, and that nothing unobservable stops it."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders import build_solution
from truth import SWELL, scenario

from factorgraph_dvl.analysis.information.observability import observability
from factorgraph_dvl.cli import main
from factorgraph_dvl.files.solution_folder import save_solution
from factorgraph_dvl.files.trial_folder import save_trial
from factorgraph_dvl.report.files.observability import to_json
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.trial import Trial

INITIAL = {
    "initial": {
        "attitude_std_deg": [0.5, 0.5, 2],
        "position_std_m": [1, 1, 1],
    }
}
SHIPPED = Path(__file__).resolve().parents[2] / "data" / "seed-a-phase-90"
CALM = {"sway": {}, "current_m_s": [0.2, 0, 0]}
THREE_SCALES = {"trial": {"dvl": {"scale_error_std": [0.1, 0.1, 0.1]}}}
WALKING = {"imu": {"gyro_noise_deg_sqrt_h": 0.1, "gyro_bias_walk_deg_h_sqrt_h": 1.0}}
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*args: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as caught:
            main([str(arg) for arg in args])
        text = capsys.readouterr()
        return int(caught.value.code or 0), text.out, text.err

    return call


def written(trial: Trial, folder: Path) -> Path:
    save_trial(trial, folder / "trial")
    return folder / "trial"


def strict(file: Path) -> dict:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(file.read_text(), parse_constant=refuse)


# Long enough that start values lead to one minimum: shorter ones, which are searched for several,
# stand as two seconds.
LENGTH_S = 32.0


def adrift(seconds: float = LENGTH_S, **changes: object) -> Trial:
    drift = {"start": {"speed_m_s": 0}, "manoeuvres": [{"straight_s": seconds}], "noise": True}
    return simulate(scenario(**{**CALM, **drift, **changes}), 1)


def under_way(seconds: float = LENGTH_S, **changes: object) -> Trial:
    return simulate(
        scenario(**{**CALM, "manoeuvres": [{"straight_s": seconds}], "noise": True, **changes}), 1
    )


UNOBSERVABLE = {
    "drifting": adrift,
    "straight": under_way,
    "straight in a swell": lambda: under_way(sway=SWELL),
    "without GNSS": lambda: replace(under_way(trial=INITIAL), gnss=None),
    "without DVL": lambda: replace(under_way(), dvl=None),
    "without both": lambda: replace(under_way(trial=INITIAL), gnss=None, dvl=None),
    "one ping": lambda: under_way(dvl={"no_lock_s": [[1, 1e3]]}),
    "two seconds": lambda: under_way(2.0),
    "two seconds adrift": lambda: adrift(2.0),
    "three scales": lambda: under_way(**THREE_SCALES),
    "walking biases": lambda: under_way(**WALKING),
    "no current": lambda: adrift(current_m_s=[0, 0, 0], dvl={"velocity_std_m_s": 0.001}),
    "fixed": lambda: under_way(
        trial={
            "dvl": {
                "misalignment_deg": [2, 2, 30],
                "misalignment_std_deg": [0, 0, 0],
                "scale_error": 0.005,
                "scale_error_std": 0,
                "lever_arm_m": [1, 1.2, 1.4],
                "lever_arm_std_m": [0, 0, 0],
            }
        }
    ),
    "bias and current": lambda: under_way(
        dvl={"reference": "water"}, trial={"dvl": {"bias_std_m_s": [1, 1, 1]}}
    ),
    "gap": lambda: under_way(imu={"gaps_s": [[8.0, 12.0]]}),
}


# Much like another one of them.
VARIANTS = (
    *("straight in a swell", "two seconds adrift", "three scales", "no current"),
    *("one ping", "walking biases", "gap", "without GNSS"),
)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow if n in VARIANTS else ()) for n in UNOBSERVABLE],
)
def test_nothing_unobservable_stops_it(name: str, tmp_path: Path, run: Run) -> None:
    trial = UNOBSERVABLE[name]()
    out = tmp_path / "out"
    drawn = name in ("straight", "without GNSS", "bias and current")
    options = [] if drawn else ["--no-figures"]
    code, _, err = run("observability", written(trial, tmp_path), "--out", out, *options)
    # Along what only noise shows, descent may not end; the command then says so as `solve` does.
    assert code == (1 if "the solver did not converge" in err else 0), err
    assert "Traceback" not in err
    assert "figures could not be drawn" not in err
    found = strict(out / "observability.json")
    assert found["kind"] == "trial"
    assert found["segments"]
    for component in found["marginals"]["components"].values():
        assert component["std"] > 0.0
    shares = found["shares"]
    if shares is not None:
        total = np.array(shares["prior"]) + np.sum(shares["segments"], axis=0)
        np.testing.assert_allclose(total, 1.0, atol=1e-6)
        assert np.min([shares["prior"], *shares["segments"]]) >= -1e-9
    if trial.dvl is None or name == "fixed":
        assert found["singular_values"] is None
        assert any("singular values" in text for text in found["missing"])
    else:
        assert len(found["singular_values"]["segments"]) == len(found["segments"])
        assert (out / "singular_values.png").exists() == drawn


def test_a_straight_run_names_its_four_directions(tmp_path: Path, run: Run) -> None:
    out = tmp_path / "out"
    changes = {"dvl": {"misalignment_deg": [0, 0, 0]}, "start": {"heading_deg": 0}}
    trial = under_way(60.0, **changes)
    code, text, _ = run("observability", written(trial, tmp_path), "--out", out, "--no-figures")
    assert code == 0
    found = strict(out / "observability.json")
    (stack,) = found["singular_values"]["segments"]
    assert stack["label"] == "steady"
    assert stack["observed_directions"] == 3
    named = [d["dominant"] for d in stack["directions"] if not d["observed"]]
    assert sorted(named) == [
        ["lever_arm_x_m"],
        ["lever_arm_y_m"],
        ["lever_arm_z_m"],
        ["misalignment_y_deg"],
    ]
    open_ones = [d["dominant"] for d in found["marginals"]["directions"][:10]]
    for name in named:
        assert name in open_ones
        assert f"{name[0]} is not determined by the data" in text
    components = found["marginals"]["components"]
    for name in ("misalignment_x_deg", "misalignment_z_deg", "scale_error"):
        assert components[name]["observable"]
    for (name,) in named:
        assert not components[name]["observable"]
        assert components[name]["std_over_prior"] > 0.98
    # As in the directions of the data, so along the trial.
    with (out / "history.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert min(float(row["lever_arm_x_m_std"]) for row in rows) > 9.9


def test_the_shipped_trial(tmp_path: Path, run: Run) -> None:
    out, segments = tmp_path / "out", tmp_path / "segments.yaml"
    segments.write_text("segments: [{start_s: 0, end_s: 100, label: first part}]\n")
    code, text, _ = run("observability", SHIPPED, "--out", out, "--segments", segments)
    assert code == 0
    found = strict(out / "observability.json")
    assert [s["label"] for s in found["segments"]] == ["first part", "other"]
    for name in ("singular_values", "std_along_trial", "correlation", "directions", "shares"):
        assert (out / f"{name}.png").stat().st_size > 10_000
    with (out / "observability.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["component"] for row in rows] == list(found["marginals"]["components"])
    for row in rows:
        shares = [float(row[name]) for name in ("share_prior", "share_1", "share_2")]
        assert sum(shares) == pytest.approx(1.0)
    with (out / "history.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    # The history ends at the posterior.
    for row in rows:
        assert float(last[f"{row['component']}_std"]) == pytest.approx(float(row["std"]), rel=1e-3)
    assert "first part" in text
    # Another run replaces it only when told to.
    assert run("observability", SHIPPED, "--out", out)[0] == 2


@pytest.mark.slow
def test_a_solution_alone(tmp_path: Path, run: Run) -> None:
    folder, out = tmp_path / "solution", tmp_path / "out"
    assert run("solve", SHIPPED, "--out", folder, "--no-figures", "--quiet")[0] == 0
    code, _, err = run("observability", folder, "--out", out, "--no-figures")
    assert code == 0
    found = strict(out / "observability.json")
    assert found["kind"] == "solution"
    assert found["shares"] is None
    assert "they need the trial itself" in err
    assert "assumed σ" in found["singular_values"]["scaling"]
    assert not (out / "history.csv").exists()
    labels = [s["label"] for s in found["segments"]]
    assert labels == ["accelerating", *["steady", "turning"] * 3, "accelerating"]
    calibration = strict(folder / "calibration.json")
    for parameter in calibration["parameters"].values():
        for value in parameter["std"]:
            stated = [c["std"] for c in found["marginals"]["components"].values()]
            assert any(value == pytest.approx(s) for s in stated)


def test_a_solution_that_did_not_converge_exits_1(tmp_path: Path, run: Run) -> None:
    save_solution(build_solution(converged=False), tmp_path / "solution")
    code, _, err = run("observability", tmp_path / "solution", "--out", tmp_path / "out")
    assert code == 1
    assert "did not converge" in err
    assert (tmp_path / "out" / "observability.json").exists()


def test_a_bare_solution_says_what_it_lacks() -> None:
    bare = replace(build_solution(), estimates=(), covariance=np.zeros((0, 0)))
    view = observability(bare)
    assert view.marginals is None
    assert view.point_set is None
    assert any("posterior against prior" in text for text in view.missing)
    assert json.loads(to_json(view, "x"))["marginals"] is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("segments: []", "segments"),
        ("segment: []", "unknown key"),
        ("segments: [{start_s: 5, end_s: 1, label: a}]", "`end_s` must be above `start_s`"),
        (
            "segments: [{start_s: 0, end_s: 9, label: a}, {start_s: 5, end_s: 12, label: b}]",
            "overlap",
        ),
        ("segments: [{start_s: 0, end_s: 9}]", "missing key"),
    ],
)
def test_wrong_segments(text: str, message: str, tmp_path: Path, run: Run) -> None:
    file = tmp_path / "segments.yaml"
    file.write_text(text)
    out = tmp_path / "out"
    code, _, err = run("observability", SHIPPED, "--out", out, "--segments", file)
    assert code == 2
    assert "segments.yaml" in err
    assert message in err
    assert not out.exists()


def test_neither_trial_nor_solution(tmp_path: Path, run: Run) -> None:
    code, _, err = run("observability", tmp_path / "none", "--out", tmp_path / "out")
    assert code == 2
    assert "does not exist" in err
