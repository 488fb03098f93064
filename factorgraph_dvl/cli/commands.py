"""The commands by name: the module of each is imported where the command is used."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import typer
from typer.core import TyperCommand, TyperGroup

from factorgraph_dvl.errors import DataError, SolveError

_P = ParamSpec("_P")
_R = TypeVar("_R")

# Measured with `solve` at a state a second: 0.40 GB for 120 000 IMU samples with 12 000 rows of
# other sensors; 0.74 GB for 480 000 with 48 000, 0.69 GB for half of these samples.
_LIBRARIES_GB = 1.5
_BASE_GB = 0.29
_GB_PER_SAMPLE = 0.22e-6
_GB_PER_ROW = 7.1e-6


def naming_memory(command: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a command that reports the memory it needs if there is too little."""

    @wraps(command)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        try:
            return command(*args, **kwargs)
        except MemoryError:
            trial = kwargs.get("trial_path")
        # The memory of the command is free again here.
        samples, rows = _sizes(trial) if isinstance(trial, Path) else (0, 0)
        need = ""
        if samples:
            size = _BASE_GB + _GB_PER_SAMPLE * samples + _GB_PER_ROW * rows
            need = (
                f": a trial of {samples} IMU samples and {rows} other measurements needs about "
                f"{size:.1f} GB, and libraries reserve {_LIBRARIES_GB:g} GB of address space"
            )
        raise SolveError(
            f"there is not enough memory{need}",
            hint="Use more memory, a shorter span of time, or IMU samples at a lower rate",
        )

    return run


def _sizes(trial_path: Path) -> tuple[int, int]:
    """Return the rows of a trial's IMU and of its other sensors; 0 if unknown."""
    from factorgraph_dvl.files.tables import count_rows
    from factorgraph_dvl.files.trial_folder import record_files

    try:
        imu, *others = (count_rows(file) for file in record_files(trial_path))
    except Exception:
        # The estimate is optional: it must not replace the error.
        return 0, 0
    return imu, sum(others)


# Function of each command within this subpackage, and what a list of commands says of it.
COMMANDS = {
    "demo": (
        "simulate.demo",
        "Simulate a trial, calibrate its DVL, and open the page of the result.",
    ),
    "simulate": ("simulate.simulate", "Simulate a trial with known truth."),
    "solve": (
        "solve.solve",
        "Estimate calibration and trajectory from all data of a trial.",
    ),
    "replay": (
        "replay.replay",
        "Feed a trial in the order of time, and show what was known when.",
    ),
    "kalman": (
        "solve.kalman",
        "Calibrate or navigate with a Kalman filter, for comparison with `solve`.",
    ),
    "inspect": (
        "inspect.inspect",
        "Show the records of a trial, and check their units and signs.",
    ),
    "crosscheck": (
        "crosscheck.crosscheck",
        "Compare two results of one trial with each other and with the truth.",
    ),
    "observability": (
        "observability.observability",
        "Show which parameters the data determine, and which motion contributes to them.",
    ),
    "plan": (
        "plan.plan",
        "Predict the σ of a planned trial, and propose manoeuvres if requirements are missed.",
    ),
    "deadreckon": (
        "deadreckon.deadreckon",
        "Integrate the DVL's velocity before and after calibration, and compare the tracks.",
    ),
    "report": (
        "report.report",
        "Write the page of a result, or a page that compares several results.",
    ),
    "export": (
        "export.export",
        "Export the trajectory or the calibration of a solution, or the records of a trial.",
    ),
    "instrument": (
        "instrument.instrument",
        "Print a calibration in the form your instrument expects, with its verdict.",
    ),
    "correct": (
        "correct.correct",
        "Correct the record of a DVL or of its beams with a calibration, and write its matrix.",
    ),
    "allan": (
        "allan.allan",
        "Find the noise of an IMU from a static record, by its Allan deviation.",
    ),
    "reproduce": (
        "reproduce.reproduce",
        "Measure what a publication states: each equation, table, figure and claim.",
    ),
    "campaign": (
        "campaign.campaign",
        "Solve many trials, and calibrate all of them jointly. Existing results are kept.",
    ),
    "import": (
        "import_files.import_",
        "Import raw files of instruments: velocity logs, GNSS, attitude, IMU.",
    ),
}


def command(name: str) -> TyperCommand:
    """Return a command with its arguments and options.

    Parameters
    ----------
    name : str
        Name as on the command line.
    """
    module, function = COMMANDS[name][0].split(".")
    alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    found = getattr(import_module(f"{__package__}.{module}"), function)
    alone.command(name)(naming_memory(found))
    out = typer.main.get_command(alone)
    assert isinstance(out, TyperCommand)
    return out


class _Listed(TyperCommand):
    """A command of which only name and summary are known until it is used."""

    def make_context(self, *args: Any, **options: Any) -> Any:
        """Return the context of the command itself."""
        assert self.name is not None
        context = command(self.name).make_context(*args, **options)
        if (error := lost_folder()) is not None:
            raise error
        return context


def lost_folder() -> DataError | None:
    """Return an error if the current directory was deleted: no relative path can be read then."""
    try:
        os.getcwd()
    except FileNotFoundError:
        return DataError(
            "the current directory no longer exists",
            expected="a directory that was not deleted or replaced",
            hint="Change to another one, such as by `cd ~`, or back to its name",
        )
    return None


class Commands(TyperGroup):
    """All commands: their list imports none of their modules."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        for name, (_, summary) in COMMANDS.items():
            self.add_command(_Listed(name, help=summary))
