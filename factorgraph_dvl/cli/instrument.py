"""The command `instrument`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from factorgraph_dvl.cli.console import stdout
from factorgraph_dvl.cli.options import Anyway, Target
from factorgraph_dvl.cli.verdict import end_with


def instrument(
    calibration: Annotated[
        Path, typer.Argument(metavar="CALIBRATION", help="calibration.json, or its folder.")
    ],
    target: Annotated[
        Target | None,
        typer.Option("--for", metavar="TARGET", help=f"As settings: {', '.join(Target)}."),
    ] = None,
    anyway: Anyway = False,
) -> None:
    """Print a calibration in the form your instrument expects, with its verdict.

    With --for, as the settings of a vehicle or an instrument: a joint of URDF, a transform of ROS,
    parameters of ArduPilot, a command of Water Linked. Red and grey values are comments. A result
    that is not to be used ends with exit code 1.

    Examples:
      factorgraph-dvl instrument out/calibration.json

      factorgraph-dvl instrument out --for ardupilot
    """
    import yaml

    from factorgraph_dvl.analysis.vehicle_settings import settings_text
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
    text = instrument_text(found) if target is None else settings_text(found, target.value)
    if events.active() and target is None:
        events.emit(events.Result("instrument.yaml", yaml.safe_load(text)))
        return
    stdout().print(text, markup=False, highlight=False, soft_wrap=True, end="")
