"""The commands `simulate` and `demo`: a trial with known truth, and its calibration."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer

from factorgraph_dvl.cli import events
from factorgraph_dvl.cli.console import print_written, stdout
from factorgraph_dvl.cli.options import Force, Quiet, claim_output
from factorgraph_dvl.cli.solve import solve
from factorgraph_dvl.errors import DataError


def simulate(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="Scenario, a YAML file.")],
    out: Annotated[Path, typer.Option("--out", metavar="TRIAL", help="Trial folder to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 0,
    force: Force = False,
    parquet: Annotated[
        bool, typer.Option("--parquet", help="Write tables as Parquet instead of CSV.")
    ] = False,
) -> None:
    """Simulate a trial with known truth.

    Examples:
      factorgraph-dvl simulate configs/cruise.yaml --out trial --seed 1
    """
    from factorgraph_dvl.files.trial_folder import OWNED, check_simulated, save_trial
    from factorgraph_dvl.simulation import load_scenario
    from factorgraph_dvl.simulation import simulate as run

    check_simulated(out)
    claim_output(out, force=force, owned=OWNED, inputs=(config,))
    start = perf_counter()
    scenario = load_scenario(config)
    save_trial(run(scenario, seed), out, force=force, parquet=parquet, seed=seed)
    if events.active():
        print_written(out)
        return
    stdout().print(
        f"Wrote trial {scenario.name} to {out} in {perf_counter() - start:.1f} s",
        markup=False,
        soft_wrap=True,
    )


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
