"""The command `inspect`."""

from __future__ import annotations

from factorgraph_dvl.cli import events
from factorgraph_dvl.cli.console import print_table, say, stdout
from factorgraph_dvl.cli.options import TrialPath


def inspect(trial_path: TrialPath) -> None:
    """Show the records of a trial, and check their units and signs.

    Examples:
      factorgraph-dvl inspect data/seed-a-phase-90
    """
    from factorgraph_dvl.files.trial_folder import load_trial
    from factorgraph_dvl.plausibility.survey import survey
    from factorgraph_dvl.report.terminal.tables import (
        finding_lines,
        imu_lines,
        motion_line,
        sensor_table,
    )

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
