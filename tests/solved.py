"""Short trials at their minimum, solved once for all tests of a process."""

from __future__ import annotations

from functools import cache

from truth import scenario

from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import settled_minimum, solved_problems
from factorgraph_dvl.solvers.fixed_directions import SolvedProblem
from factorgraph_dvl.solvers.rounds import SettledMinimum
from factorgraph_dvl.trial import Trial

# Near enough that no other minimum is looked for.
_ROUGHLY_KNOWN = {
    "misalignment_deg": [0, 0, 25],
    "misalignment_std_deg": [10, 10, 10],
    "lever_arm_m": [1, 1, 1],
    "lever_arm_std_m": [2, 3, 4],
}


@cache
def turning() -> tuple[Trial, SolvedProblem]:
    """A minute with turns, which shows all of the calibration."""
    trial = simulate(scenario(noise=True, trial={"dvl": _ROUGHLY_KNOWN}), 1)
    return trial, solved_problems(trial)[0]


@cache
def straight() -> tuple[Trial, SolvedProblem]:
    """A straight run in calm water, which shows no lever arm and no roll about the course."""
    scene = scenario(
        noise=True,
        manoeuvres=[{"straight_s": 30}],
        sway={},
        current_m_s=[0, 0, 0],
        dvl={"misalignment_deg": [0, 0, 0], "lever_arm_m": [2, -1, 3]},
        trial={"dvl": _ROUGHLY_KNOWN | {"misalignment_deg": [0, 0, 0]}},
    )
    trial = simulate(scene, 1)
    return trial, solved_problems(trial)[0]


def before_fixing(trial: Trial) -> SettledMinimum:
    """Return the minimum of a trial before directions are fixed."""
    return settled_minimum(trial)[0]
