"""Print the graph of a ship without an IMU
========================================

Solve three minutes of a simulated ship with a gyrocompass, GNSS and a DVL, and print one line for
each kind of factor: how many there are, the keys of the first, and what these are::

    python examples/graph_without_imu.py
"""

import gtsam

import factorgraph_dvl as fd

trial = fd.simulate("examples/short-ship.yaml", seed=1)
solved, *_ = fd.solved_problems(trial)
problem = solved.problem
graph, start = problem.nonlinear_graph()

# Letters of the keys: attitude `r`, turn rates `w`, position and velocity `x`; others have names.
names = {problem.key(p.name): p.name for p in problem.parameters}
for process in problem.processes:
    names |= {process.key(j): process.name for j in range(process.time.size)}
kinds: dict[tuple[str, ...], list[list[int]]] = {}
for i in range(graph.size()):
    keys = graph.at(i).keys()
    letters = {114: "attitude", 119: "turn rates", 120: "track"}
    kind = tuple(names.get(k) or letters[gtsam.symbolChr(k)] for k in keys)
    kinds.setdefault(kind, []).append(keys)
for kind, every in kinds.items():
    first = " ".join(gtsam.DefaultKeyFormatter(key) for key in every[0])
    print(f"{len(every):5d} × {first}: {', '.join(dict.fromkeys(kind))}")
print("error", graph.error(start), "cost", problem.evaluate(start).cost)
