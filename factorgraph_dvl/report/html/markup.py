"""HTML text, tables and both languages of a phrase."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from factorgraph_dvl.message import Message
from factorgraph_dvl.quality.texts import chinese, component_names, text_of
from factorgraph_dvl.report.table import Cell as DescribedCell
from factorgraph_dvl.report.table import Component, Mark, Table


@dataclass(frozen=True)
class Html:
    """Text that is HTML already; all other text is escaped."""

    text: str


# HTML, or what is escaped text.
Cell = object


def html(cell: Cell) -> str:
    """Return a cell as HTML."""
    return cell.text if isinstance(cell, Html) else escape(str(cell))


def both(english: str, own: str = "") -> Html:
    """Return a phrase in English and Chinese; the page shows one of them.

    Parameters
    ----------
    english : str
        The phrase, as `words` lists it.
    own : str, optional
        Its Chinese, if it is composed of several.
    """
    other = own or chinese(english)
    if other == english:
        return Html(escape(english))
    return Html(
        f'<span lang="en">{escape(english)}</span><span lang="zh-Hans">{escape(other)}</span>'
    )


def said(message: Message | str) -> Html:
    """Return a message in English and Chinese; a text from a file as it is."""
    return both(text_of(message), text_of(message, "zh"))


def joined(*cells: Cell, by: str = " ") -> Html:
    """Return cells one after the other."""
    return Html(by.join(map(html, cells)))


def element(name: str, *cells: Cell, **attributes: str) -> Html:
    """Return an element; underscores in attributes are hyphens, and nothing at the end."""
    given = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(value)}"'
        for key, value in attributes.items()
    )
    return Html(f"<{name}{given}>{''.join(map(html, cells))}</{name}>")


def table(
    header: Sequence[Cell],
    rows: Sequence[Sequence[Cell]],
    *,
    label: str,
    numeric: Sequence[int] = (),
) -> Html:
    """Return a table that scrolls on a narrow screen, by touch or keyboard.

    Parameters
    ----------
    header : sequence of Cell
        Names of the columns.
    rows : sequence of sequence of Cell
        The first cell of each names it.
    label : str
        What the table shows, as `words` lists it.
    numeric : sequence of int, optional
        Columns of numbers.
    """

    def kind(i: int) -> dict[str, str]:
        return {"class_": "number"} if i in numeric else {}

    head = [element("th", cell, scope="col", **kind(i)) for i, cell in enumerate(header)]
    body = [
        element(
            "tr",
            *(
                element("th", cell, scope="row") if i == 0 else element("td", cell, **kind(i))
                for i, cell in enumerate(row)
            ),
        )
        for row in rows
    ]
    inner = element(
        "table",
        element("thead", element("tr", *head)),
        element("tbody", *body),
    )
    return element("div", inner, class_="scroll", role="group", tabindex="0", **labels(label))


def described(table_: Table, *, label: str) -> Html:
    """Return a table as it is described, with its words in both languages."""
    numeric = [i for i, column in enumerate(table_.columns) if column.numeric]
    rows = [list(map(_described, row)) for row in table_.rows]
    return table([both(c.header) for c in table_.columns], rows, label=label, numeric=numeric)


def _described(cell: DescribedCell) -> Cell:
    if isinstance(cell, Component):
        return component_cell(cell.name)
    return grade_cell(cell.text) if isinstance(cell, Mark) else cell


def component_cell(component: str) -> Html:
    """Return the name of a component without its unit."""
    english, own, _ = component_names(component)
    return both(english, own)


def grade_cell(grade: str) -> Html:
    """Return a grade with a sign of its own, so that colour is not needed."""
    return element("span", both(grade), class_=f"grade grade-{grade}")


def labels(english: str) -> dict[str, str]:
    """Return attributes that name an element in both languages."""
    return {"aria_label": english, "data_en": english, "data_zh": chinese(english)}


@dataclass(frozen=True)
class Section:
    """A section of a page: its key, its title as `words` lists it, and what is in it."""

    key: str
    title: str
    content: tuple[Cell, ...]

    def html(self) -> Html:
        """Return the section with its heading."""
        heading = element("h2", both(self.title), id_=f"{self.key}-title")
        named = {"id_": self.key, "aria_labelledby": f"{self.key}-title"}
        return element("section", heading, *self.content, **named)


def section(title: str, *content: Cell, key: str) -> Section:
    """Return a section."""
    return Section(key, title, content)


def paragraph(*cells: Cell) -> Html:
    """Return a paragraph."""
    return element("p", *cells)


def items(cells: Sequence[Cell]) -> Html:
    """Return a list."""
    return element("ul", *(element("li", cell) for cell in cells))


def folded(summary: str, *cells: Cell) -> Html:
    """Return cells that open on demand."""
    return element("details", element("summary", both(summary)), *cells)
