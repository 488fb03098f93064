"""Which rows of measurements go to which factors: one factor for all that share nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from factorgraph_dvl.geometry.vectors import IntArray

# Measurements whose rows are found at once. Chosen: some ten megabytes.
CHUNK = 4000


@dataclass(frozen=True)
class Part:
    """Some measurements of an observation, and the places of their rows in factors.

    Each place is the index of a factor, rows there, and rows of these measurements.
    """

    measurements: slice | IntArray
    places: list[tuple[int, slice, slice]]


@dataclass(frozen=True)
class Layout:
    """Factors of several observations.

    Parameters
    ----------
    nodes : ndarray, shape (F, k)
        Nodes of each factor.
    rows : list of int
        Rows of each factor.
    parts : list of list of Part
        Where the rows of each observation go, some measurements at a time.
    """

    nodes: IntArray
    rows: list[int]
    parts: list[list[Part]]


def factor_layout(nodes: Sequence[IntArray], components: Sequence[int]) -> Layout:
    """Return the factors of observations, one for each set of nodes.

    Parameters
    ----------
    nodes : sequence of ndarray, shape (M, k)
        Nodes that each of the M measurements of an observation depends on.
    components : sequence of int
        Rows of a measurement of each observation.
    """
    every = np.concatenate(nodes)
    # One number for each set of nodes, which sorts as the set does.
    number = np.ravel_multi_index(tuple(every.T), tuple(every.max(axis=0, initial=0) + 1))
    _, index, place = np.unique(number, return_index=True, return_inverse=True)
    counts = np.zeros(len(index), dtype=int)
    ends = np.cumsum([len(each) for each in nodes])[:-1]
    parts = []
    for own, d in zip(np.split(place, ends), components, strict=True):
        order = np.argsort(own, kind="stable")
        present, first, count = np.unique(own[order], return_index=True, return_counts=True)
        in_order = bool(np.all(np.diff(order) == 1))
        of_observation = []
        for a, b in pairwise(_part_edges(first, own.size)):
            whole = slice(int(first[a]), int(first[b - 1] + count[b - 1]))
            begin, there = d * (first[a:b] - first[a]), counts[present[a:b]]
            rows = d * count[a:b]
            places = zip(
                present[a:b].tolist(),
                map(slice, there.tolist(), (there + rows).tolist()),
                map(slice, begin.tolist(), (begin + rows).tolist()),
                strict=True,
            )
            of_observation.append(Part(whole if in_order else order[whole], list(places)))
        parts.append(of_observation)
        counts[present] += d * count
    return Layout(every[index], counts.tolist(), parts)


def _part_edges(first: IntArray, count: int) -> list[int]:
    """Return where parts of some measurements begin and end, by the first ones of factors."""
    begins = np.searchsorted(first, np.arange(0, count, CHUNK))
    return np.unique(np.append(begins, first.size)).tolist()
