"""Solve trials of all kinds, and store what came out: `python tests/store_results.py FILE`.

`tests/trials/test_results.py` compares with `tests/data/results.json`, which this made of the
state before the package was laid out anew.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from windows import with_no_window

from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solvers.batch import solve

CONFIGS = Path(__file__).parent.parent / "configs"
TRIALS = (
    *("seed-a-phase-90", "cruise", "cruise-mems", "cruise-beams", "dive", "dive-one-beacon"),
    "star",
)


def results(name: str) -> dict[str, Any]:
    """Return the results of a configuration, its repetitions sailed once, as JSON holds them."""
    data = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text(encoding="utf-8"))
    for manoeuvre in data["manoeuvres"]:
        if "repeat" in manoeuvre:
            manoeuvre["repeat"] = 1
    # Estimated noise would move all numbers by a part of what chance moves it.
    trial = with_no_window(replace(simulate(parse_scenario(data), seed=1), noise="stated"))
    solution = solve(trial, rate_hz=1.0)
    motion = solution.trajectory
    rows = np.linspace(0, motion.time.size - 1, 5).astype(int)
    return {
        "converged": bool(solution.converged),
        "estimates": {
            e.name: {
                "value": np.ravel(e.value).tolist(),
                "std": np.ravel(e.std).tolist(),
                "observable": np.ravel(e.observable).tolist(),
            }
            for e in solution.estimates
        },
        "trajectory": {
            "time": motion.time[rows].tolist(),
            "geodetic": motion.geodetic[rows].tolist(),
            "velocity": motion.velocity[rows].tolist(),
            "rph": motion.rph[rows].tolist(),
            "position_std": motion.position_std[rows].tolist(),
        },
    }


if __name__ == "__main__":
    out = {name: results(name) for name in TRIALS}
    Path(sys.argv[1]).write_text(json.dumps(out, indent=1) + "\n", encoding="utf-8")
