"""What `inspect` calls an error, before and after something is found from a trial."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.text import Text

from factorgraph_dvl.cli.console import stderr

if TYPE_CHECKING:
    from collections.abc import Iterable

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
    from factorgraph_dvl.quality.refusal import accepted_errors
    from factorgraph_dvl.quality.survey import survey
    from factorgraph_dvl.quality.survey_planar import survey_planar
    from factorgraph_dvl.trial import PlanarTrial

    found = survey_planar(trial) if isinstance(trial, PlanarTrial) else survey(trial)
    return accepted_errors(found, anyway=anyway)


def contradicted(findings: Iterable[Finding]) -> bool:
    """Whether a result is not to be used for another reason than that it did not converge."""
    from factorgraph_dvl.sensors.finding import Code, errors_of

    return any(f.code != Code.NOT_CONVERGED for f in errors_of(findings))


def print_contradiction() -> None:
    """Say that a result was found that is not to be used."""
    text = "error: records contradict each other or the model: not to be used; see the warnings"
    stderr().print(Text(text, "red"), soft_wrap=True)
