"""The command `correct`: calibrated beams as an equivalent DVL."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from factorgraph_dvl.cli.console import print_written, say, stdout, warn
from factorgraph_dvl.cli.options import Anyway, Force, TrialPath, claim_output


def correct(
    trial_path: TrialPath,
    calibration: Annotated[
        Path, typer.Argument(metavar="CALIBRATION", help="calibration.json, or its folder.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")],
    force: Force = False,
    anyway: Anyway = False,
) -> None:
    """Convert the calibrated beams of a trial to a DVL record, and write the matrix for it."""
    import numpy as np

    from factorgraph_dvl.analysis.beam_quality import calibration_of, check_same_instrument
    from factorgraph_dvl.errors import DataError
    from factorgraph_dvl.io.calibration_file import check_usable, load_calibration
    from factorgraph_dvl.io.corrected_record import OWNED, save_corrected
    from factorgraph_dvl.io.trial_folder import inputs_of, load_trial

    claim_output(out, force=force, owned=OWNED, inputs=(*inputs_of(trial_path), calibration))
    trial = load_trial(trial_path, anyway=anyway)
    if trial.beams is None:
        raise DataError(
            "the trial has no beams", where=str(trial_path), expected="a dvl_beams section"
        )
    found = load_calibration(calibration, body_axes=trial.body_axes)
    check_usable(found, trial.body_axes, str(calibration), anyway=anyway)
    beams = calibration_of(trial.beams, found)
    check_same_instrument(trial.beams, beams, str(calibration))
    record = save_corrected(
        trial.beams, beams.directions_b, beams.scale_error, beams.lever_arm, out, force=force
    )
    for finding in trial.notes:
        say(finding)
    own = {p.name for p in trial.beams.parameters()}
    unknown = [
        name
        for e in found.estimates
        if e.name in own
        for name in np.array(e.component_names)[~e.observable & (e.prior_std > 0.0)]
    ]
    if unknown:
        warn(
            f"the calibration could not determine {', '.join(unknown)}: the record uses the prior"
        )
    pings = f"{record.locked.sum()} of {record.time.size} pings have a velocity"
    stdout().print(pings, markup=False, highlight=False)
    print_written(out)
