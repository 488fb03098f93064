"""The command `demo`: a simulated trial, its calibration, and the page of the result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from factorgraph_dvl.cli.console import stdout
from factorgraph_dvl.cli.options import Force, Quiet
from factorgraph_dvl.cli.simulate import simulate
from factorgraph_dvl.cli.solve import solve
from factorgraph_dvl.errors import DataError

_SCENARIO = "seed-a-phase-90.yaml"
# The trial that ships in data/ was made with this seed.
_SEED = 1


def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")] = Path(
        "factorgraph-dvl-demo"
    ),
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Do not open the page of the result.")
    ] = False,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Simulate a trial, calibrate its DVL, and open the page of the result.

    Examples:
      factorgraph-dvl demo
    """
    import webbrowser
    from importlib.resources import as_file, files

    from factorgraph_dvl.files.solution_folder import REPORT_FILE

    if (out / "trial.yaml").exists():
        raise DataError("contains a trial", where=str(out), expected="a new folder")
    trial, result = out / "trial", out / "result"
    with as_file(files("factorgraph_dvl.reproduce") / "configs" / _SCENARIO) as config:
        simulate(config, trial, seed=_SEED, force=force, parquet=True)
    solve(trial, result, force=force, quiet=quiet)
    page = (result / REPORT_FILE).resolve()
    stdout().print(f"The result on one page: {page}", markup=False, soft_wrap=True)
    if not no_browser:
        webbrowser.open(page.as_uri())
