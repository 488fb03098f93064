"""The command `correct`: the record of a calibrated DVL, or of calibrated beams."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from factorgraph_dvl.cli.console import print_written, say, stdout, warn
from factorgraph_dvl.cli.options import Anyway, CalibrationPath, Force, TrialPath, claim_output


def correct(
    trial_path: TrialPath,
    calibration: CalibrationPath,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")],
    force: Force = False,
    anyway: Anyway = False,
) -> None:
    """Correct the record of a DVL or of its beams with a calibration, and write its matrix.

    Examples:
      factorgraph-dvl correct TRIAL out/calibration.json --out corrected
    """
    import numpy as np

    from factorgraph_dvl.analysis.beam_quality import calibration_of, check_same_instrument
    from factorgraph_dvl.errors import DataError
    from factorgraph_dvl.files.calibration_file import check_usable, load_calibration
    from factorgraph_dvl.files.corrected_record import (
        OWNED,
        save_corrected,
        save_corrected_dvl,
    )
    from factorgraph_dvl.files.trial_folder import inputs_of, load_trial
    from factorgraph_dvl.sensors.dvl import CALIBRATED, MISALIGNMENT
    from factorgraph_dvl.sensors.dvl_beams import DvlBeams

    claim_output(out, force=force, owned=OWNED, inputs=(*inputs_of(trial_path), calibration))
    trial = load_trial(trial_path, anyway=anyway)
    sensor = trial.beams or trial.dvl
    if sensor is None:
        raise DataError(
            "the trial has no DVL", where=str(trial_path), expected="a dvl or dvl_beams section"
        )
    found = load_calibration(calibration, body_axes=trial.body_axes)
    check_usable(found, trial.body_axes, str(calibration), anyway=anyway)
    if isinstance(sensor, DvlBeams):
        beams = calibration_of(sensor, found)
        check_same_instrument(sensor, beams, str(calibration))
        record = save_corrected(
            sensor, beams.directions_b, beams.scale_error, beams.lever_arm, out, force=force
        )
    else:
        values = {name: v for name, v in found.values.items() if name in CALIBRATED}
        if MISALIGNMENT not in values:
            raise DataError(
                f"the calibration has no {MISALIGNMENT}",
                where=str(calibration),
                expected="the calibration of a DVL",
            )
        record = save_corrected_dvl(sensor, values, out, force=force)
    for finding in trial.notes:
        say(finding)
    own = {p.name for p in sensor.parameters()}
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
