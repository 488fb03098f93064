"""The command `instrument`."""

from __future__ import annotations

from factorgraph_dvl.cli.console import stdout
from factorgraph_dvl.cli.options import Anyway, CalibrationPath
from factorgraph_dvl.cli.verdict import end_with


def instrument(
    calibration: CalibrationPath,
    anyway: Anyway = False,
) -> None:
    """Print a calibration in the form your instrument expects, with its verdict.

    Red and grey values are comments. A result that is not to be used ends with exit code 1.

    Examples:
      factorgraph-dvl instrument out/calibration.json
    """
    import yaml

    from factorgraph_dvl.cli import events
    from factorgraph_dvl.files.calibration_file import check_usable, load_calibration
    from factorgraph_dvl.report.files.instrument import instrument_text, verdict_text

    found = load_calibration(calibration)
    check_usable(found, found.body_axes, str(calibration), anyway=True)
    if found.verdict.grade == "do not use" and not anyway:
        if not events.active():
            text = verdict_text(found.verdict)
            stdout().print(text, markup=False, highlight=False, soft_wrap=True, end="")
        end_with(found.verdict)
    text = instrument_text(found)
    if events.active():
        events.emit(events.Result("instrument.yaml", yaml.safe_load(text)))
        return
    stdout().print(text, markup=False, highlight=False, soft_wrap=True, end="")
