"""A sheet of paper that text, tables and drawings fill from the top."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, fontManager
from matplotlib.textpath import TextToPath

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.quality.texts import Language, chinese
from factorgraph_dvl.report.figures.drawing import DARK, GREY, LIGHT

# A4, and its margins, inches.
WIDTH, HEIGHT = 8.27, 11.69
LEFT, TOP, BOTTOM = 0.75, 0.7, 0.7
INNER = WIDTH - 2.0 * LEFT
# Sizes of letters, pt, from a line to the next, and points per inch.
TEXT, HEADING, SMALL = 8.5, 12.0, 7.0
_LEADING, _POINT = 1.4, 72.0
# How much wider bold letters are. Measured with DejaVu Sans.
_BOLD = 1.15
# Fonts with Chinese characters, the first that is installed; DejaVu Sans comes with Matplotlib.
_CHINESE = ("Noto Sans CJK SC", "Noto Sans CJK JP", "Source Han Sans SC", "WenQuanYi Zen Hei",
            "Microsoft YaHei", "SimHei", "PingFang SC")  # fmt: skip
_LATIN = "DejaVu Sans"


class Sheet:
    """A page of A4 with a position from which on it is free.

    Parameters
    ----------
    language : {'en', 'zh'}
        Language of what is written.
    footer : str
        What the bottom of the page says.
    """

    def __init__(self, language: Language, footer: str) -> None:
        self.figure = Figure(figsize=(WIDTH, HEIGHT))
        self.language = language
        self._fonts = fonts(language)
        self._y = TOP
        self._write(footer, LEFT, HEIGHT - 0.45, SMALL, GREY)

    @property
    def left(self) -> float:
        """Height that is free, inches."""
        return HEIGHT - BOTTOM - self._y

    def said(self, english: str) -> str:
        """Return a phrase in the language of the page."""
        return english if self.language == "en" else chinese(english)

    def space(self, height: float) -> None:
        """Leave a height free, inches."""
        self._y += height

    def heading(self, english: str, size: float = HEADING) -> None:
        """Write a heading, with a line below it."""
        self.space(0.08)
        self._lines([self.said(english)], size, DARK, weight="bold")
        self._rule()
        self.space(0.07)

    def text(
        self, text: str, size: float = TEXT, *, colour: str = DARK, weight: str = "normal"
    ) -> None:
        """Write a paragraph that is in the language of the page already."""
        self._lines(self._wrapped(text, size, INNER), size, colour, weight=weight)
        self.space(0.04)

    def table(
        self,
        header: Sequence[str],
        rows: Sequence[Sequence[str]],
        *,
        numeric: Sequence[int] = (),
        size: float = TEXT,
    ) -> None:
        """Write a table, whose columns are as wide as what they contain; the last is wrapped.

        Parameters
        ----------
        header : sequence of str
            Names of the columns; none are written if it is empty.
        rows : sequence of sequence of str
            Cells.
        numeric : sequence of int, optional
            Columns that are aligned to the right.
        size : float, optional
            Size of letters, pt.
        """
        count = len(rows[0]) if rows else len(header)
        lines = [*([header] if header else []), *rows]
        gap = 0.14
        widths = [
            max(self._width(row[k], size) * (_BOLD if row is header else 1.0) for row in lines)
            + gap
            for k in range(count)
        ]
        widths[-1] = min(widths[-1], INNER - sum(widths[:-1]))
        at = [LEFT + sum(widths[:k]) for k in range(count)]
        for i, row in enumerate(lines):
            cells = [*([cell] for cell in row[:-1]), self._wrapped(row[-1], size, widths[-1])]
            weight = "bold" if header and i == 0 else "normal"
            for k, cell in enumerate(cells):
                right = k in numeric
                x = at[k] + (widths[k] - gap if right else 0.0)
                for n, line in enumerate(cell):
                    y = self._y + n * _step(size)
                    self._write(line, x, y, size, DARK, weight=weight, right=right)
            self.space(_step(size) * max(map(len, cells)) + 0.03)
            if header and i == 0:
                self._rule()
                self.space(0.04)
        self.space(0.08)

    def axes(self, height: float, columns: int = 1, *, labels: float = 0.8) -> list[Axes]:
        """Return axes side by side over the width of the page.

        Parameters
        ----------
        height : float
            Height of each, inches.
        columns : int, optional
            Number of axes.
        labels : float, optional
            Room for the numbers and the label to the left of each, inches.
        """
        pitch = INNER / columns
        width = pitch - labels
        y = 1.0 - (self._y + height) / HEIGHT
        self.space(height)
        return [
            self.figure.add_axes(
                ((LEFT + k * pitch + labels) / WIDTH, y, width / WIDTH, height / HEIGHT)
            )
            for k in range(columns)
        ]

    def _lines(self, lines: Sequence[str], size: float, colour: str, *, weight: str) -> None:
        for line in lines:
            self._write(line, LEFT, self._y, size, colour, weight=weight)
            self.space(_step(size))

    def _write(
        self,
        text: str,
        x: float,
        y: float,
        size: float,
        colour: str,
        *,
        weight: str = "normal",
        right: bool = False,
    ) -> None:
        self.figure.text(
            x / WIDTH, 1.0 - y / HEIGHT, text, fontsize=size, color=colour, fontweight=weight,
            family=self._fonts, ha="right" if right else "left", va="top", parse_math=False,
        )  # fmt: skip

    def _rule(self) -> None:
        ax = self.figure.add_axes((LEFT / WIDTH, 1.0 - self._y / HEIGHT, INNER / WIDTH, 0.0004))
        ax.set_axis_off()
        ax.axhline(0.5, color=GREY, lw=0.8)
        ax.patch.set_facecolor(LIGHT)

    def _width(self, text: str, size: float) -> float:
        return _width_at_one(text, self._fonts) * size / _POINT

    def _wrapped(self, text: str, size: float, width: float) -> list[str]:
        """Return the lines of a text; Chinese and long words break anywhere."""
        lines: list[str] = []
        line = ""
        for word in _words(text, self.language):
            if line and self._width(line + word.rstrip(), size) > width:
                lines.append(line.rstrip())
                line = ""
            line += word
            while self._width(line.rstrip(), size) > width:
                fits = max(1, int(len(line) * width / self._width(line, size)) - 1)
                lines.append(line[:fits])
                line = line[fits:]
        return [*lines, line.rstrip()]


def fonts(language: Language) -> list[str]:
    """Return the fonts of a language, by preference.

    Raises
    ------
    ConfigError
        If no font has Chinese characters.
    """
    if language == "en":
        return [_LATIN]
    installed = {font.name for font in fontManager.ttflist}
    own = next((name for name in _CHINESE if name in installed), None)
    if own is None:
        raise ConfigError(
            "no font with Chinese characters is installed", where="--language zh",
            expected=f"one of {', '.join(_CHINESE)}",
        )  # fmt: skip
    # Numbers and signs look the same in both languages.
    return [_LATIN, own]


def _words(text: str, language: Language) -> list[str]:
    if language == "zh":
        # No line begins with a closing mark.
        return re.findall(r".[，。、；：！？）”]*", text)
    return [word + " " for word in text.split()]


@lru_cache(maxsize=4096)
def _measured(text: str, family: str) -> float:
    prop = FontProperties(fname=findfont(FontProperties(family=family)), size=1.0)
    return float(TextToPath().get_text_width_height_descent(text, prop, ismath=False)[0])


def _width_at_one(text: str, families: Sequence[str]) -> float:
    """Return the width of a text in letters of 1 pt, pt."""
    latin = "".join(c for c in text if ord(c) < 0x2E80)
    other = len(text) - len(latin)
    # Chinese characters are as wide as they are high.
    return _measured(latin, families[0]) + other


def _step(size: float) -> float:
    """Return the height of a line, inches."""
    return size * _LEADING / _POINT
