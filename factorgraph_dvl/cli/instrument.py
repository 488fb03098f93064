"""The command `instrument`: calibrated beams as the instrument that they amount to."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from factorgraph_dvl.cli.console import print_written
from factorgraph_dvl.cli.options import Force, TrialPath


def instrument(
    trial_path: TrialPath,
    solution_path: Annotated[
        Path, typer.Argument(metavar="SOLUTION", help="Solution folder with the calibration.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")],
    force: Force = False,
) -> None:
    """Convert calibrated beams to an instrument matrix and a corrected DVL record."""
    from factorgraph_dvl.analysis.beam_quality import calibration_of
    from factorgraph_dvl.errors import DataError
    from factorgraph_dvl.io.folders import check_output
    from factorgraph_dvl.io.instrument_folder import save_instrument
    from factorgraph_dvl.io.solution_folder import load_solution
    from factorgraph_dvl.io.trial_folder import load_trial

    check_output(out, force=force)
    trial = load_trial(trial_path)
    if trial.beams is None:
        raise DataError(
            "the trial has no beams", where=str(trial_path), expected="a dvl_beams section"
        )
    calibration = calibration_of(trial.beams, load_solution(solution_path))
    save_instrument(
        trial.beams,
        calibration.directions_b,
        calibration.scale_error,
        calibration.lever_arm,
        out,
        force=force,
    )
    print_written(out)
