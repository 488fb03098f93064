"""Order of elimination by nested dissection in time.

A variable that measurements of some span of time depend on stands in the way between what comes
before and what comes after every time within. Where those at the middle of a trial are eliminated
last, both halves do not depend on each other, and so on in each half: the tree has as many levels
as the number of nodes has digits, and cliques of one level are alike (George, Nested dissection of
a regular finite element mesh, SIAM Journal on Numerical Analysis 10(2), 1973).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.vectors import Array


@dataclass(frozen=True)
class Spans:
    """Spans of time whose measurements depend on some variables, one after another.

    Parameters
    ----------
    keys : sequence of sequence of int
        Keys of the variables that have each span, in the order of elimination.
    time : ndarray, shape (K,), s
        Times of the variables: the span of each is open, from the one before to the one after.
    """

    keys: Sequence[Sequence[int]]
    time: Array


def elimination_order(cuts: Array, every: Iterable[Spans]) -> list[int]:
    """Return keys of variables in the order of elimination: of each half before what divides it.

    Parameters
    ----------
    cuts : ndarray, shape (K,), s
        Times that divide the trial, ascending.
    every : iterable of Spans
        All variables but those that all measurements share.
    """
    items: list[tuple[int, int, int, int]] = []
    for number, spans in enumerate(every):
        padded = np.concatenate([[-np.inf], spans.time, [np.inf]])
        # Cuts within have the numbers first + 1 to last, counted from one.
        first = np.searchsorted(cuts, padded[:-2], side="right").tolist()
        last = np.searchsorted(cuts, padded[2:], side="left").tolist()
        for own, before, cut in zip(spans.keys, first, last, strict=True):
            # Of numbers in a row, the one that ends with the most zeros divides the trial before
            # the others; the last of those that it divides.
            level = (before ^ cut).bit_length()
            end = cut | (1 << level) - 1 >> 1
            items += [(end, level, number, key) for key in own]
    return [key for *_, key in sorted(items, key=lambda item: item[:3])]
