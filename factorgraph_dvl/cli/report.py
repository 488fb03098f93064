"""The command `report`: the page of a result, and of several side by side."""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from factorgraph_dvl.cli.console import print_file, warn
from factorgraph_dvl.cli.options import Force
from factorgraph_dvl.errors import as_text

if TYPE_CHECKING:
    from factorgraph_dvl.files.run_file import Run
    from factorgraph_dvl.report.html.content import Result
    from factorgraph_dvl.solution import Solution


class ReportLanguage(StrEnum):
    """Languages of a report on paper."""

    ENGLISH = "en"
    CHINESE = "zh"


def report(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Solution folders.", show_default=False)
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="File to write; by default report.html or report.pdf in the folder.",
        ),
    ] = None,
    force: Force = False,
    redact: Annotated[
        bool,
        typer.Option("--redact", help="Leave out positions, names of trials and names of files."),
    ] = False,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Write three pages of A4 to sign: report.pdf.")
    ] = False,
    language: Annotated[
        ReportLanguage, typer.Option("--language", help="Language of the PDF.")
    ] = ReportLanguage.ENGLISH,
) -> None:
    """Write the page of a result, or a page that compares several results.

    A page is one file that works offline. A cross-check in DIR/crosscheck and dead reckoning in
    DIR/deadreckon are shown too. `--pdf` writes the result for paper.

    Examples:
      factorgraph-dvl report out

      factorgraph-dvl report out --pdf

      factorgraph-dvl report out-batch out-kalman --out comparison.html
    """
    from factorgraph_dvl.errors import ConfigError
    from factorgraph_dvl.files.folders import write_file
    from factorgraph_dvl.files.solution_folder import PDF_FILE, REPORT_FILE
    from factorgraph_dvl.report.html.content import redact as redacted_result
    from factorgraph_dvl.report.html.page import comparison_page, report_page
    from factorgraph_dvl.report.pdf.document import write_pdf

    if pdf and len(folders) > 1:
        raise ConfigError("--pdf shows one result", expected="one solution folder")
    if out is None and len(folders) > 1:
        raise ConfigError(
            "--out is missing", expected="the page to write, such as --out comparison.html"
        )
    results = [_load(folder) for folder in folders]
    if pdf:
        (shown,) = map(redacted_result, results) if redact else results
        file = out or folders[0] / PDF_FILE
        write_file(
            file, lambda path: write_pdf(shown, path, language.value), force=force or out is None
        )
        print_file(file)
        return
    if len(results) == 1:
        page = report_page(results[0], redacted=redact)
    else:
        page = comparison_page(results, redacted=redact)
    file = out or folders[0] / REPORT_FILE
    # The page in a solution folder is made to be made again.
    write_file(file, lambda path: path.write_text(page, "utf-8"), force=force or out is None)
    print_file(file)


def _load(folder: Path) -> Result:
    """Return what a solution folder contains."""
    from factorgraph_dvl.campaign.files import CAMPAIGN_FILE, REPORT_FILE
    from factorgraph_dvl.errors import ConfigError
    from factorgraph_dvl.files.run_file import read_run
    from factorgraph_dvl.files.solution_folder import (
        CHECK_FILE,
        load_solution,
        read_check,
        read_halves,
        read_history,
    )
    from factorgraph_dvl.report.html.content import Result

    if (folder / CAMPAIGN_FILE).exists():
        raise ConfigError(
            "this is the result of a campaign",
            where=as_text(folder),
            expected="a solution folder",
            hint=f"Open {as_text(folder / REPORT_FILE)}: `campaign` wrote its page",
        )
    run = read_run(folder)
    return Result(
        name=as_text(folder),
        solution=load_solution(folder),
        run=_builtins(run) if run is not None else {},
        history=read_history(folder),
        crosscheck=_read_json(folder / "crosscheck" / "crosscheck.json"),
        dead_reckoning=_read_json(folder / "deadreckon" / "deadreckon.json"),
        halves=read_halves(folder),
        check=_read_json(folder / CHECK_FILE),
        check_table=read_check(folder),
    )


def _read_json(file: Path) -> dict[str, Any]:
    """Return a JSON object; nothing where there is no such file."""
    import msgspec

    from factorgraph_dvl.errors import DataError
    from factorgraph_dvl.settings.convert import from_json
    from factorgraph_dvl.settings.files import MEGABYTE, read_bytes

    if not os.path.lexists(file):
        return {}
    content = read_bytes(file, limit=16 * MEGABYTE, expected="a result in JSON")
    try:
        return from_json(content, dict[str, Any])
    except (msgspec.MsgspecError, RecursionError) as error:
        raise DataError(f"cannot be read ({error})", where=str(file)) from None


def _builtins(run: Run) -> dict[str, Any]:
    import msgspec

    found: dict[str, Any] = msgspec.to_builtins(run)
    return found


def write_report(
    folder: Path,
    name: str,
    solution: Solution,
    run: Run,
    history: tuple[Any, tuple[str, ...], Any] | None = None,
) -> None:
    """Write run.json, and report.html; a page that fails is a warning: results are worth more."""
    from factorgraph_dvl.files.run_file import RUN_FILE, encode_run
    from factorgraph_dvl.files.solution_folder import (
        CHECK_FILE,
        REPORT_FILE,
        read_check,
        read_halves,
    )
    from factorgraph_dvl.report.html.content import Result
    from factorgraph_dvl.report.html.page import report_page

    (folder / RUN_FILE).write_bytes(encode_run(run))
    try:
        result = Result(
            as_text(name),
            solution,
            _builtins(run),
            history,
            halves=read_halves(folder),
            check=_read_json(folder / CHECK_FILE),
            check_table=read_check(folder),
        )
        (folder / REPORT_FILE).write_text(report_page(result), encoding="utf-8")
    except Exception as error:
        warn(f"{REPORT_FILE} could not be written: {type(error).__name__}: {error}")
