"""What `inspect` calls an error, before and after a trial is solved."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.text import Text

from factorgraph_dvl.cli.console import stderr, warn

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from factorgraph_dvl.sensors.finding import Finding
    from factorgraph_dvl.trial import PlanarTrial, Trial


def errors_in(trial: Trial | PlanarTrial, *, anyway: bool) -> tuple[Finding, ...]:
    """Return the errors in the records of a trial.

    Parameters
    ----------
    trial : Trial or PlanarTrial
        As loaded.
    anyway : bool
        Go on where records cannot be used.

    Raises
    ------
    DataError
        If there are records that cannot be used, unless `anyway`.
    """
    from factorgraph_dvl.errors import DataError
    from factorgraph_dvl.quality.survey import survey
    from factorgraph_dvl.quality.survey_planar import survey_planar
    from factorgraph_dvl.trial import PlanarTrial

    found = survey_planar(trial) if isinstance(trial, PlanarTrial) else survey(trial)
    unusable = [str(f) for f in found.errors if f.unusable]
    if unusable and not anyway:
        raise DataError(
            "; ".join(unusable),
            where=trial.name,
            hint="Correct the record, remove its section from trial.yaml, or go on with --anyway",
        )
    return found.errors


@contextmanager
def explaining(errors: Sequence[Finding]) -> Iterator[None]:
    """Show errors in the records if what is done with them fails."""
    from factorgraph_dvl.errors import FactorgraphDvlError

    try:
        yield
    except FactorgraphDvlError:
        for error in errors:
            warn(str(error))
        raise


def print_contradiction() -> None:
    """Say that a solution was found that is not to be used."""
    text = "error: records contradict each other or the model: not to be used; see the warnings"
    stderr().print(Text(text, "red"), soft_wrap=True)
