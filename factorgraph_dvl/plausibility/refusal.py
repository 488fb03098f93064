"""Errors in the records of a trial: they refuse it, or go with what is found from it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from factorgraph_dvl.errors import DataError, FactorgraphDvlError
from factorgraph_dvl.plausibility.survey import Survey
from factorgraph_dvl.quality.finding import Code, Finding


def accepted_errors(found: Survey, *, anyway: bool) -> tuple[Finding, ...]:
    """Return the errors in records with which there is still something to solve.

    And warnings of axes that the course contradicts: no residual shows these.

    Parameters
    ----------
    found : Survey
        Of the trial.
    anyway : bool
        Accept all of them.

    Raises
    ------
    DataError
        If there are records that cannot be used, unless `anyway`.
    """
    unusable = [str(f) for f in found.errors if f.unusable]
    if unusable and not anyway:
        raise DataError(
            "; ".join(unusable),
            where=found.trial,
            hint="Correct the record, leave its sensor out, or go on with --anyway "
            "(in Python anyway=True)",
        )
    off_course = [f for f in found.problems if f.code == Code.COURSE and f.severity == "warning"]
    return (*found.errors, *off_course)


@contextmanager
def explained(errors: Sequence[Finding]) -> Iterator[None]:
    """Add errors in the records as notes to the exception if what is done with them fails."""
    try:
        yield
    except FactorgraphDvlError as failure:
        for error in errors:
            failure.add_note(str(error))
        raise
