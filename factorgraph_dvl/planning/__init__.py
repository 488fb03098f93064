"""Plans: the predicted posterior of a trial, and manoeuvres to add to it.

A plan is a scenario without noise draws. It becomes a trial, which is linearised at its true
motion with its stated noise: the posterior follows without solving.
"""

from __future__ import annotations

from factorgraph_dvl.planning.prediction import Prediction, predict
from factorgraph_dvl.planning.proposal import Proposal, propose
from factorgraph_dvl.planning.requirements import Requirement, requirements

__all__ = [
    "Prediction",
    "Proposal",
    "Requirement",
    "predict",
    "propose",
    "requirements",
]
