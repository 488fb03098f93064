"""What to enter in a DVL, on the page: the table, its conventions, the drawing of the vessel."""

from __future__ import annotations

from collections.abc import Iterator

from factorgraph_dvl.analysis.instrument_terms import (
    InstrumentTerms,
    instrument_of,
    transceiver_of,
)
from factorgraph_dvl.analysis.mount import mount_in_words
from factorgraph_dvl.quality.texts import text_of
from factorgraph_dvl.report.entries import (
    MOUNT,
    TITLE,
    USBL_DEFINITIONS,
    USBL_TITLE,
    conventions,
    entries_table,
    sum_with_compass,
    usbl_table,
)
from factorgraph_dvl.report.html.content import Result
from factorgraph_dvl.report.html.markup import Html, both, described, element, joined, paragraph
from factorgraph_dvl.report.html.vessel import vessel_drawing


def entries_content(result: Result) -> Iterator[Html]:
    """Yield what to enter in the DVL, or that there is nothing to enter."""
    yield element("h3", both(TITLE))
    if result.solution.verdict.grade == "do not use":
        yield paragraph(both("Enter nothing: this result must not be used."))
        return
    terms = instrument_of(result.solution)
    if (found := sum_with_compass(result.solution.findings)) is not None:
        yield paragraph(joined(both("Mount and compass:"), both(str(found), found.chinese)))
    mount = (both(text_of(said), text_of(said, "zh")) for said in mount_in_words(terms.axes))
    yield paragraph(joined(both(MOUNT), *mount))
    drawing = vessel_drawing(terms, result.solution, result.run.get("settings", {}))
    yield element(
        "div",
        element("div", values_to_enter(terms, result.maker)),
        element("div", drawing),
        class_="entries",
    )
    if (transceiver := transceiver_of(result.solution)) is not None:
        yield element("h3", both(USBL_TITLE))
        yield described(usbl_table(transceiver), label=USBL_TITLE)
        yield paragraph(joined(*map(both, USBL_DEFINITIONS)))


def values_to_enter(terms: InstrumentTerms, maker: str | None = None) -> Html:
    """Return the table of what to enter, with its conventions."""
    return joined(
        described(entries_table(terms, maker), label=TITLE),
        paragraph(joined(*map(both, conventions(terms, maker)))),
    )
