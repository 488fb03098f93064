"""The command `campaign`: many trials, or many seeds of a scenario."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from factorgraph_dvl.cli import events
from factorgraph_dvl.cli.console import (
    CountLine,
    print_folder,
    print_table,
    stderr,
    stdout,
    warn,
)
from factorgraph_dvl.cli.exit_codes import NO_RESULT
from factorgraph_dvl.cli.options import (
    Anyway,
    FigureKind,
    Figures,
    Force,
    NoFigures,
    Quiet,
    claim_output,
)
from factorgraph_dvl.cli.verdict import print_entries, print_verdict

if TYPE_CHECKING:
    from collections.abc import Sequence

    from factorgraph_dvl.campaign.cluster import Run
    from factorgraph_dvl.campaign.record import RunRecord
    from factorgraph_dvl.campaign.trials import Campaign


def campaign(
    trials: Annotated[
        list[Path],
        typer.Argument(metavar="TRIAL...", help="Trial folders; or a scenario, with --seeds."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")],
    seeds: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Simulate a scenario N times.")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Processes on this machine (one for each core)."),
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Address of a running Dask scheduler.")
    ] = None,
    covariates: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Table of covariates, such as temperature."),
    ] = None,
    force: Force = False,
    no_figures: NoFigures = False,
    figures: Figures = FigureKind.PNG,
    anyway: Anyway = False,
    quiet: Quiet = False,
) -> None:
    """Solve many trials, and calibrate all of them jointly. Existing results are kept.

    Examples:
      factorgraph-dvl campaign monday tuesday --out campaign
    """
    from factorgraph_dvl.campaign.files import CAMPAIGN_FILE, OWNED
    from factorgraph_dvl.errors import ConfigError
    from factorgraph_dvl.files.folders import SETTINGS_FILE

    if workers is not None and scheduler is not None:
        raise ConfigError("--workers and --scheduler exclude each other", expected="one of them")
    if seeds is not None and (len(trials) != 1 or covariates is not None):
        raise ConfigError(
            "--seeds belongs to one scenario", expected="campaign SCENARIO --seeds N"
        )
    for path in trials:
        if not path.exists():
            kind = "a trial folder" if seeds is None else "a scenario, a YAML file"
            raise ConfigError("does not exist", where=str(path), expected=kind)
        if seeds is None and not path.is_dir() and path.name != SETTINGS_FILE:
            raise ConfigError(
                "is not a trial",
                where=str(path),
                expected="a trial folder, or a scenario --seeds N",
            )
    # What an earlier run of this command left is its own, whether it ended or was killed.
    resumed = (out / CAMPAIGN_FILE).exists()
    claim_output(out, force=force or resumed, owned=OWNED, inputs=trials)
    found = workers, scheduler, quiet
    if seeds is not None:
        _run_seeds(trials[0].resolve(), seeds, out.resolve(), *found)
    else:
        options = [
            *(["--no-figures"] if no_figures else []),
            *([f"--figures={figures.value}"] if figures != FigureKind.PNG else []),
            *(["--anyway"] if anyway else []),
        ]
        _run_trials(trials, out.resolve(), options, covariates, anyway, *found)


def _run_trials(
    paths: Sequence[Path],
    out: Path,
    options: Sequence[str],
    covariates: Path | None,
    anyway: bool,
    workers: int | None,
    scheduler: str | None,
    quiet: bool,
) -> None:
    from factorgraph_dvl.campaign.files import CAMPAIGN_FILE, REPORT_FILE, write_campaign
    from factorgraph_dvl.campaign.page import write_page
    from factorgraph_dvl.campaign.trial_run import name_of, run_trial
    from factorgraph_dvl.campaign.trials import (
        assembled,
        check_covariates,
        labels_of,
        read_covariates,
    )
    from factorgraph_dvl.files.calibration_file import CALIBRATION_FILE

    follow = {} if covariates is None else read_covariates(covariates)
    # Before hours of solving, not after.
    check_covariates(follow, [name for path in paths if (name := name_of(path))])
    labels = labels_of(paths)
    runs: list[Run] = [
        (run_trial, (str(path.resolve()), label, str(out), tuple(options)))
        for path, label in zip(paths, labels, strict=True)
    ]
    records = _run(runs, labels, out, workers, scheduler, quiet)
    found = assembled(paths, labels, records, out, anyway=anyway, covariates=follow)
    write_campaign(found, out)
    write_page(found, out)
    _print_campaign(found)
    calibration = [] if found.joint is None else [CALIBRATION_FILE]
    print_folder(out, *calibration, CAMPAIGN_FILE)
    if not events.active():
        stdout().print(f"Open {out / REPORT_FILE}", markup=False, soft_wrap=True)
    _end(len(found.failed), len(runs))


def _run_seeds(
    scenario: Path,
    seeds: int,
    out: Path,
    workers: int | None,
    scheduler: str | None,
    quiet: bool,
) -> None:
    from factorgraph_dvl.campaign.files import CAMPAIGN_FILE, write_seeds
    from factorgraph_dvl.campaign.monte_carlo import SeedRecord, monte_carlo, run_seed
    from factorgraph_dvl.campaign.page import write_seed_page
    from factorgraph_dvl.simulation import load_scenario

    # One error now, in place of one for each seed.
    load_scenario(scenario)
    labels = [str(seed) for seed in range(seeds)]
    runs: list[Run] = [(run_seed, (str(scenario), seed, str(out))) for seed in range(seeds)]
    given = _run(runs, labels, out, workers, scheduler, quiet)
    records = [
        r
        if isinstance(r, SeedRecord)
        else SeedRecord(name=r.name, fingerprint="", done=False, error=r.error)
        for r in given
    ]
    found = monte_carlo(records)
    write_seeds(found, records, scenario, out)
    write_seed_page(found, scenario, seeds, out)
    if found is not None:
        ratios = [replace(s, name=f"rms of error over σ of {s.name}") for s in found.ratio]
        for s in (found.nees, *ratios, *found.coverage):
            band = f"{s.low:.4g} to {s.high:.4g}"
            outside = "" if s.inside else ": OUTSIDE"
            text = f"{s.name}: {s.value:.4g}, by chance (99 %) {band}{outside}"
            stdout().print(text, markup=False, soft_wrap=True)
    print_folder(out, CAMPAIGN_FILE)
    _end(sum(not r.done for r in records), len(runs))


def _run(
    runs: Sequence[Run],
    labels: Sequence[str],
    out: Path,
    workers: int | None,
    scheduler: str | None,
    quiet: bool,
) -> list[RunRecord]:
    """Return the records of runs, in their order, with progress."""
    from factorgraph_dvl.campaign.cluster import connected, default_workers, records
    from factorgraph_dvl.campaign.files import write_begun

    found: dict[int, RunRecord] = {}
    count = min(workers or default_workers(), len(runs))
    try:
        with connected(count, scheduler) as client, CountLine(len(runs), quiet=quiet) as progress:
            write_begun(out)
            if not quiet:
                link = client.dashboard_link
                stderr().print(f"Dashboard: {link}", markup=False, highlight=False, soft_wrap=True)
            for i, record in records(client, runs, labels):
                found[i] = record
                progress(labels[i] if record.done else f"{labels[i]} FAILED: {record.error}")
    except KeyboardInterrupt:
        warn("interrupted; the same command continues after the finished runs")
        raise
    return [found[i] for i in range(len(runs))]


def _print_campaign(found: Campaign) -> None:
    """Print the verdict of the whole, joint calibration, changes, trials, and what to enter."""
    from factorgraph_dvl.analysis.instrument_terms import has_instrument_terms, instrument_of
    from factorgraph_dvl.campaign.files import for_the_next
    from factorgraph_dvl.campaign.tables import joint_table, trials_table
    from factorgraph_dvl.quality.notation import with_std
    from factorgraph_dvl.quality.texts import text_of
    from factorgraph_dvl.report.entries import entries_table

    joint = found.joint
    expected = None if joint is None else for_the_next(found, joint)
    if expected is not None:
        print_verdict(expected.verdict)
    for t in found.trials:
        if t.unused:
            warn(f"{t.label} is not used: {text_of(t.unused)}")
    if joint is None:
        warn("no trial has a result that can be used: there is no joint calibration")
    else:
        print_table(joint_table(found, joint), "unit")
        for i, change in enumerate(joint.changes):
            text = (
                f"Change after {found.used[change.after].name}: "
                f"{joint.information.names[change.component]} by {with_std(*joint.step(i))}, "
                f"p = {change.probability:.1g}"
            )
            stdout().print(text, markup=False, soft_wrap=True)
    print_table(trials_table(found))
    if (
        expected is not None
        and expected.verdict.grade != "do not use"
        and has_instrument_terms(expected)
    ):
        print_entries(entries_table(instrument_of(expected)))


def _end(failed: int, count: int) -> None:
    """End with `NO_RESULT` if runs have no result."""
    if failed:
        stderr().print(f"error: {failed} of {count} runs failed", markup=False, style="red")
        raise typer.Exit(NO_RESULT)
