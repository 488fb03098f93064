"""Whether the stars of a star tracker fit their catalogue."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.special import chdtrc

from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import TOO_LARGE
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.sensors.records import at_row
from factorgraph_dvl.sensors.star import Star

# Probability of a misfit of stars below which it is no chance. Chosen: one trial in 10 000.
_BY_CHANCE = 1e-4
# Misfit of stars to their catalogue that no standard deviation stated too small explains: chosen.
_WRONG_STARS = 3.0


def star_catalogue_findings(aids: Iterable[Aid]) -> tuple[Finding, ...]:
    """Return a finding for a star tracker whose stars do not fit the catalogue."""
    return tuple(f for aid in aids if isinstance(aid, Star) for f in _misfit(aid))


def _misfit(star: Star) -> list[Finding]:
    """Return a finding if the stars do not fit their catalogue, naming the worst of them."""
    v = star.vectors_of_epochs
    if v is None or not star.misfit > TOO_LARGE:
        return []
    square = star.star_misfits() ** 2
    freedom = 2 * v.time.size - 3 * star.time.size
    if chdtrc(freedom, square.sum()) > _BY_CHANCE:
        return []
    stars, row, which = np.unique(
        np.round(v.inertial, 4), axis=0, return_index=True, return_inverse=True
    )
    each = np.bincount(which.ravel(), square) / np.bincount(which.ravel())
    worst = int(np.argmax(each))
    wrong = star.misfit > _WRONG_STARS
    text = message(
        "star_catalogue.wrong" if wrong else "star_catalogue.differs",
        misfit=star.misfit,
        star=stars[worst],
        row=at_row(star.source, row[worst]),
    )
    return [
        Finding(
            Code.STAR_CATALOGUE,
            text,
            sensor=star.label,
            severity="error" if wrong else "warning",
        )
    ]
