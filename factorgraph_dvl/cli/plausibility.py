"""What `inspect` calls an error, before something is found from a trial."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from factorgraph_dvl.quality.finding import Finding
    from factorgraph_dvl.trial import Trial


def errors_in(trial: Trial, *, anyway: bool) -> tuple[Finding, ...]:
    """Return the errors in the records of a trial.

    Parameters
    ----------
    trial : Trial
        As loaded.
    anyway : bool
        Go on where records cannot be used.

    Raises
    ------
    DataError
        If there are records that cannot be used, unless `anyway`.
    """
    from factorgraph_dvl.plausibility.refusal import accepted_errors
    from factorgraph_dvl.plausibility.survey import survey

    return accepted_errors(survey(trial), anyway=anyway)
