"""The command `inspect`."""

from __future__ import annotations

from factorgraph_dvl.cli.console import print_table, stdout, warn
from factorgraph_dvl.cli.options import TrialPath


def inspect(trial_path: TrialPath) -> None:
    """Show what a trial holds, and check its units and signs."""
    from factorgraph_dvl.analysis.survey import survey
    from factorgraph_dvl.io.trial_folder import load_trial
    from factorgraph_dvl.report.tables import finding_lines, motion_line, sensor_table

    trial = load_trial(trial_path)
    result = survey(trial)
    console = stdout()
    print_table(sensor_table(result))
    console.print(motion_line(result), markup=False, soft_wrap=True)
    for note in trial.notes:
        warn(note)
    for line in finding_lines(result):
        console.print(line, soft_wrap=True)
