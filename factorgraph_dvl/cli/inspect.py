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
    from factorgraph_dvl.io.planar_folder import is_planar, load_planar_trial
    from factorgraph_dvl.io.trial_folder import load_trial
    from factorgraph_dvl.quality.survey import survey
    from factorgraph_dvl.quality.survey_planar import survey_planar
    from factorgraph_dvl.report.terminal.tables import (
        finding_lines,
        imu_lines,
        motion_line,
        sensor_table,
    )

    if is_planar(trial_path):
        planar = load_planar_trial(trial_path)
        result, notes, assumed = survey_planar(planar), planar.notes, []
    else:
        trial = load_trial(trial_path, anyway=True)
        result, notes = survey(trial), trial.notes
        assumed = [] if trial.imu is None else imu_lines(trial.imu.settings)
    console = stdout()
    print_table(sensor_table(result), "longest s", "from s")
    for line in (motion_line(result), *assumed):
        console.print(line, markup=False, soft_wrap=True)
    for note in notes:
        say(note)
    if events.active():
        for each in result.findings:
            say(each)
        return
    for finding in finding_lines(result):
        console.print(finding, soft_wrap=True)
