"""The command `instrument`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from factorgraph_dvl.cli.console import stdout
from factorgraph_dvl.cli.options import Anyway


def instrument(
    calibration: Annotated[
        Path, typer.Argument(metavar="CALIBRATION", help="calibration.json, or its folder.")
    ],
    anyway: Anyway = False,
) -> None:
    """Print a calibration in the terms of instruments: angles, %, ppm, TRDI's EA and EI.

    Examples:
      factorgraph-dvl instrument out/calibration.json
    """
    import yaml

    from factorgraph_dvl.analysis.instrument_terms import instrument_of
    from factorgraph_dvl.cli import events
    from factorgraph_dvl.files.calibration_file import check_usable, load_calibration
    from factorgraph_dvl.report.files.instrument import instrument_text

    found = load_calibration(calibration)
    check_usable(found, found.body_axes, str(calibration), anyway=anyway)
    text = instrument_text(instrument_of(found), found.trial)
    if events.active():
        events.emit(events.Result("instrument.yaml", yaml.safe_load(text)))
        return
    stdout().print(text, markup=False, highlight=False, soft_wrap=True, end="")
