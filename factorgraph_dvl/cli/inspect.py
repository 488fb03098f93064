"""The command `inspect`, and what others take from it: errors in the records of a trial."""

from __future__ import annotations

from typing import TYPE_CHECKING

from factorgraph_dvl.cli import events
from factorgraph_dvl.cli.console import print_table, say, stdout
from factorgraph_dvl.cli.options import TrialPath

if TYPE_CHECKING:
    from factorgraph_dvl.quality.finding import Finding
    from factorgraph_dvl.trial import Trial


def errors_in(trial: Trial, *, anyway: bool) -> tuple[Finding, ...]:
    """Return the errors in the records of a trial.

    Parameters
    ----------
    trial : Trial
        As loaded.
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
    for line in (motion_line(result), *assumed):
        console.print(line, markup=False, soft_wrap=True)
    for note in trial.notes:
        say(note)
    if events.active():
        for each in result.findings:
            say(each)
        return
    for finding in finding_lines(result):
        console.print(finding, soft_wrap=True)
