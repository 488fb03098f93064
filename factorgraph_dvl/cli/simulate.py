"""The command `simulate`."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer

from factorgraph_dvl.cli import events
from factorgraph_dvl.cli.console import print_written, stdout
from factorgraph_dvl.cli.options import Force, claim_output


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
