"""The command `deadreckon`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from factorgraph_dvl.cli.console import (
    ProgressLine,
    drawing,
    print_table,
    print_written,
    say,
    stdout,
    warn,
)
from factorgraph_dvl.cli.inspect import errors_in
from factorgraph_dvl.cli.options import (
    Anyway,
    FigureKind,
    Figures,
    Force,
    NoFigures,
    Quiet,
    TrialPath,
    claim_output,
)
from factorgraph_dvl.cli.verdict import end_with

if TYPE_CHECKING:
    from factorgraph_dvl.analysis.dead_reckoning.before_after import BeforeAfter
    from factorgraph_dvl.analysis.dead_reckoning.integration import OrientationAt
    from factorgraph_dvl.quality.finding import Finding
    from factorgraph_dvl.quality.verdict import Verdict
    from factorgraph_dvl.trial import Trial


# Chosen: a longer unscored end of a track, s, gets a warning; records rarely end together.
_UNSCORED_S = 10.0


def deadreckon(
    trial_path: TrialPath,
    calibration: Annotated[
        Path,
        typer.Argument(
            metavar="CALIBRATION", help="calibration.json, its folder, or a file of values."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")],
    attitude: Annotated[
        str | None,
        typer.Option(
            metavar="SOURCE",
            help="Source of the attitude: sins (default), reference (default without GNSS), "
            "record (default without IMU), or a solution folder.",
        ),
    ] = None,
    align: Annotated[
        float | None,
        typer.Option(metavar="S", min=1.0, help="Let sins use GNSS for the first S seconds only."),
    ] = None,
    force: Force = False,
    no_figures: NoFigures = False,
    figures: Figures = FigureKind.PNG,
    anyway: Anyway = False,
    quiet: Quiet = False,
) -> None:
    """Integrate the DVL's velocity before and after calibration, and compare the tracks.

    Examples:
      factorgraph-dvl deadreckon data/seed-a-phase-90 out --out out/deadreckon
    """
    from factorgraph_dvl.analysis.dead_reckoning.before_after import before_after
    from factorgraph_dvl.errors import as_text
    from factorgraph_dvl.files.external_results import own_calibration, read_calibration_values
    from factorgraph_dvl.files.folders import new_folder
    from factorgraph_dvl.files.motion_table import motion_columns
    from factorgraph_dvl.files.tables import write_table
    from factorgraph_dvl.files.trial_folder import inputs_of, load_trial
    from factorgraph_dvl.plausibility.survey import explained
    from factorgraph_dvl.quality.verdict import verdict_of
    from factorgraph_dvl.report.files import dead_reckoning as files

    read = (*inputs_of(trial_path), calibration, None if attitude is None else Path(attitude))
    claim_output(out, force=force, owned=files.OWNED, inputs=read)
    with ProgressLine(quiet=quiet) as progress:
        trial = load_trial(trial_path, anyway=anyway)
        values = read_calibration_values(calibration, trial.body_axes, anyway=anyway)
        own = own_calibration(calibration, trial.body_axes)
        errors = errors_in(trial, anyway=anyway)
        attitude = attitude or _default_attitude(trial)
        with explained(errors):
            progress("attitude")
            source, findings = _attitude(trial, attitude, align, anyway=anyway)
            progress("dead reckoning")
            result = before_after(trial, values, source)
        progress("write")
        with new_folder(out, force=force, owned=files.OWNED) as folder:
            tracks = {
                files.TRACK_FILE: result.calibrated,
                files.UNCALIBRATED_FILE: result.uncalibrated,
            }
            for name, run in tracks.items():
                write_table(folder / name, motion_columns(run.track.motion))
            if not no_figures:
                reasons = () if own is None else own.verdict.reasons
                found = (*errors, *trial.notes, *findings, *reasons)
                _draw(trial, result, folder, verdict_of(found), figures.value)
            about = {
                "trial": trial.name,
                "calibration": as_text(calibration),
                "attitude": as_text(attitude),
                "align_s": align,
                "errors": list(map(str, errors)),
            }
            (folder / files.RESULT_FILE).write_bytes(files.to_json(result, about))
    _print_errors(result)
    _say(trial, result, (*errors, *trial.notes, *findings))
    print_written(out)
    end_with(verdict_of(errors))


def _say(trial: Trial, result: BeforeAfter, findings: Sequence[Finding]) -> None:
    """Print findings, and warn of a current and of pings without bottom lock."""
    for finding in findings:
        say(finding)
    if trial.dvl is not None and trial.dvl.settings.reference == "water":
        warn("the DVL measures velocity through the water: the track drifts with the current")
    if result.calibrated.track.bridged > 0.0:
        warn(
            f"{result.calibrated.track.bridged:.1f} s without bottom lock were bridged with the "
            "velocity before and after"
        )


def _print_errors(result: BeforeAfter) -> None:
    """Print the errors of the tracks, and how far they are known."""
    from factorgraph_dvl.report.files.dead_reckoning import error_table

    if result.calibrated.score is None:
        warn("neither a reference nor GNSS covers the track, so its errors are unknown")
    else:
        print_table(error_table(result))
        distance = result.calibrated.score.path.total
        stdout().print(
            f"{distance:.6g} m, compared with {result.scored_by}", markup=False, soft_wrap=True
        )
        end, last = result.calibrated.score.time[-1], result.calibrated.track.time[-1]
        if last - end > _UNSCORED_S:
            warn(
                f"{result.scored_by} ends at {end:.1f} s, before the track ({last:.1f} s): "
                f"distance and errors are valid up to {end:.1f} s"
            )


def _default_attitude(trial: Trial) -> str:
    if trial.imu is None:
        return "record"
    return "reference" if trial.gnss is None and trial.reference is not None else "sins"


def _attitude(
    trial: Trial, source: str, align: float | None, *, anyway: bool
) -> tuple[OrientationAt, tuple[Finding, ...]]:
    """Return the attitude for the track, and findings about it."""
    import numpy as np

    from factorgraph_dvl.errors import ConfigError
    from factorgraph_dvl.geometry.units import DEG_PER_HOUR
    from factorgraph_dvl.imu.attitude_history import AttitudeHistory

    if source == "record":
        from factorgraph_dvl.imu.attitude_record import orientations

        if trial.attitude is None:
            raise ConfigError(
                "the trial has no record of roll, pitch and heading", where="--attitude record",
                expected="a trial with ins or attitude",
            )  # fmt: skip
        return orientations(trial.attitude, trial.body_axes), ()
    if align is not None and source != "sins":
        raise ConfigError("applies only to --attitude sins", where="--align")
    if source == "sins":
        from factorgraph_dvl.baselines import sins

        motion, bias, findings = sins(trial, align_s=align)
        return AttitudeHistory(trial.inertial, motion, trial.body_axes, bias).at, findings
    if source == "reference":
        if trial.reference is None:
            raise ConfigError(
                "the trial has no reference", where="--attitude reference",
                expected="sins, or a solution folder",
            )  # fmt: skip
        history = AttitudeHistory(trial.inertial, trial.reference, trial.body_axes, np.zeros(3))
        return history.at, ()
    from factorgraph_dvl.files.calibration_file import check_verdict
    from factorgraph_dvl.files.solution_folder import load_solution

    if not Path(source).is_dir():
        raise ConfigError(
            f"there is no folder {source}",
            where="--attitude",
            expected="sins, reference, record, or a solution folder",
        )
    solution = load_solution(source)
    check_verdict(solution, source, anyway=anyway)
    if solution.trial != trial.name:
        warn(f"the attitude in {source} is from trial {solution.trial}, not {trial.name}")
    names = [e.name for e in solution.estimates]
    bias = np.zeros(3)
    if "gyro_bias_deg_h" in names:
        bias = solution.estimate("gyro_bias_deg_h").value * DEG_PER_HOUR
    history = AttitudeHistory(trial.inertial, solution.trajectory, solution.body_axes, bias)
    return history.at, ()


def _draw(trial: Trial, result: BeforeAfter, folder: Path, verdict: Verdict, kind: str) -> None:
    from factorgraph_dvl.report.figures.dead_reckoning import write_dead_reckoning_figures

    with drawing():
        write_dead_reckoning_figures(trial, result, folder, verdict, kind=kind)
