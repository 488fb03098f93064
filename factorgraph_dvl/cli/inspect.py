"""The command `inspect`, and what others take from it: errors in the records of a trial."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from factorgraph_dvl.cli import events
from factorgraph_dvl.cli.console import print_table, say, stdout
from factorgraph_dvl.cli.exit_codes import NO_RESULT
from factorgraph_dvl.cli.options import TrialPath

if TYPE_CHECKING:
    from factorgraph_dvl.quality.finding import Finding
    from factorgraph_dvl.trial import Trial


def errors_in(trial: Trial, *, anyway: bool) -> tuple[Finding, ...]:
    """Return the errors in the records of a trial.

    Parameters
    ----------
    trial : Trial
        Trial as loaded.
    anyway : bool
        Go on where records cannot be used.

    Raises
    ------
    DataError
        If there are records that cannot be used, unless `anyway`.
    """
    from factorgraph_dvl.plausibility.survey import accepted_errors, survey

    return accepted_errors(survey(trial), anyway=anyway)


def inspect(trial_path: TrialPath) -> None:
    """Show the records of a trial, and check their units and signs.

    Errors come last, with their number, and end with exit code 1.

    Examples:
      factorgraph-dvl inspect data/seed-a-phase-90
    """
    from factorgraph_dvl.files.trial_folder import load_trial
    from factorgraph_dvl.plausibility.survey import survey
    from factorgraph_dvl.report.tables import finding_lines, imu_lines, motion_line, sensor_table

    trial = load_trial(trial_path, anyway=True)
    result = survey(trial)
    assumed = [] if trial.imu is None else imu_lines(trial.imu.settings)
    console = stdout()
    print_table(sensor_table(result), "longest s", "from s")
    for text in (motion_line(result), *assumed):
        console.print(text, markup=False, soft_wrap=True)
    for note in trial.notes:
        say(note)
    errors = [f for f in result.findings if f.severity == "error"]
    findings = (*(f for f in result.findings if f.severity != "error"), *errors)
    if events.active():
        for each in findings:
            say(each)
    else:
        for line in finding_lines(findings):
            console.print(line, soft_wrap=True)
        if errors:
            console.print(f"Errors: {len(errors)}. These records cannot be used.", markup=False)
    if errors:
        raise typer.Exit(NO_RESULT)
