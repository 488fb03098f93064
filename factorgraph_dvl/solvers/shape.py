"""When a parameter counts: a period or a span that a search found, and how far chance goes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.statistics.scores import Score


@dataclass(frozen=True)
class Shape:
    """What a search found of a parameter.

    Parameters
    ----------
    parameter : Parameter
        Period and start, or span, as they were found.
    tried : int
        How many there could have been.
    scatter : float
        Variance of the scores of the record elsewhere, over that of white noise; at least one.
        Noise that persists makes spans and periods by itself.
    """

    parameter: Parameter
    tried: int
    scatter: float

    @property
    def price(self) -> float:
        """What -2 log of the likelihood must fall by, as each of these may be by chance."""
        return 2.0 * float(np.log(self.tried))


Shapes = Mapping[str, Shape]


def searched(test: Score, name: str, shapes: Shapes) -> Score:
    """Return a test as that of the best of all shapes, if its parameter has one."""
    shape = shapes.get(name)
    return test if shape is None else test.divided(shape.scatter).less(shape.price)
