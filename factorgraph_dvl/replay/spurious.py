"""Spurious information of a replay: what the error of the motion adds, accumulated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.clocks import parameters_of
from factorgraph_dvl.graph.priors import prior_root
from factorgraph_dvl.graph.sensor_factor import NodeMeasurements
from factorgraph_dvl.replay.start import ReplayStart
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.statistics.spurious_information import spurious_by
from factorgraph_dvl.statistics.undetermined_directions import undetermined_directions

# Interval at which each kind of measurement is evaluated, s; chosen: the motion's covariance
# changes little within, and evaluating every measurement would double the cost of an update.
_EVERY = 1.0


class SpuriousInformation:
    """Information on the parameters that only the error of the motion makes.

    It is evaluated for some measurements of each kind, once a second, and scaled to all that
    were used since: kinds come at rates of their own, and late. The error is the whole one,
    not what is left where the parameters are known: each state is linearised at what was
    known then, so an error that all states share changes too.

    Parameters
    ----------
    start : ReplayStart
        Start of the smoother, with the spurious information up to it.

    Attributes
    ----------
    information : ndarray, shape (P, P)
        The sum so far, in units of the priors' standard deviations.
    """

    def __init__(self, start: ReplayStart) -> None:
        self.information = start.spurious
        self._start = start
        self._root = prior_root(start.parameters)
        # By kind: when it was last evaluated, and how many were used since.
        self._evaluated: dict[str, float] = {}
        self._used: Counter[str] = Counter()

    def add(
        self,
        measured: NodeMeasurements,
        motions: Sequence[Motion],
        weights: Sequence[Array],
        values: Mapping[str, Array],
        P: Array,
        time: float,
    ) -> bool:
        """Add what measurements contribute, and return whether the sum has changed.

        Parameters
        ----------
        measured : NodeMeasurements
            Measurements after a state.
        motions : sequence of Motion
            Motion at each kind of them.
        weights : sequence of ndarray, each (M, d)
            Inverse standard deviations of each kind; 0 = not used.
        values : mapping of str to ndarray
            Values of all parameters, SI.
        P : ndarray, shape (9, 9)
            Covariance of the state, in GTSAM's tangent space.
        time : float
            Time of the state, s.
        """
        changed = False
        for b, motion, weight in zip(measured.bound, motions, weights, strict=True):
            o = b.observation
            wanted = [p.name for p in measured.parameters if p.name in parameters_of(o)]
            used = int(np.count_nonzero(weight.any(axis=1)))
            if not wanted or not used:
                continue
            self._used[o.label] += used
            if time - self._evaluated.get(o.label, self._start.time) < _EVERY:
                continue
            part = spurious_by(
                o,
                b.attachment.forward,
                motion,
                weight,
                P[None],
                values,
                wanted,
                self._start.clock_zero,
            )
            root = self._root[self._start.columns(wanted)]
            share = self._used[o.label] / used
            self.information = self.information + root.T @ part.sum(axis=0) @ root * share
            self._evaluated[o.label], self._used[o.label] = time, 0
            changed = True
        return changed

    def undetermined(self, P: Array) -> Array:
        """Return the directions (P, h) of parameters of covariance P that are not observable."""
        size = len(self._root)
        if size == 0:
            return np.zeros((0, 0))
        information = self._root.T @ np.linalg.inv(P) @ self._root
        return undetermined_directions(information - np.eye(size), self.information)
