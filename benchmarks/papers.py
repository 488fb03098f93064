"""Measure what five publications state: each equation, table, figure and claim.

    python benchmarks/papers.py [--seeds 4] [--out DIR]

writes `papers.md` into out/benchmarks, or with `--out docs` that of the documentation. One
publication alone, with its figures: `factorgraph-dvl reproduce PAPER --out DIR`.
"""

from __future__ import annotations

import common

from factorgraph_dvl.reproduce import PAPERS
from factorgraph_dvl.reproduce.entry import counted
from factorgraph_dvl.reproduce.page import summary_lines

PAGE = "papers.md"
# Of most papers the items whose numbers sum up a simulation, and that one seed makes in seconds.
SAMPLED = {
    "luo-2024": ("figure 2", "table 3", "figure 4"),
    "liu-2020": ("eq. 16", "claim 2 (section 3.2)"),
    "nine-state": ("claim 3 (section 6)", "claim 5 (section 6)"),
    "chen-2021": ("start (eq. 7, lost)", "claim 2 (section 2)"),
}
INTRODUCTION = """\
# Five publications, item by item

{origin}

The tables list each numbered equation, table, figure and claim, its place in this package, and the
measurement over {seeds}. The verdict is *reproduced* as printed, *corrected* with the argument in
the measurement, or *not reproducible* with the reason. Where a verdict depends on how the print is
read, the measurement names the readings. One command makes all items and figures of a publication.
Our copies are text. They keep the quantities and units of the printed axes, but not their ranges.
The figures here have these quantities and units, and lines at the printed values:

```sh
factorgraph-dvl reproduce luo-2024 --out DIR --seeds {count} --table 3    # or --figure N, or all
```

The others are `liu-2020`, `nine-state`, `beams` and `chen-2021`.

Continuous integration runs all publications with one seed.
"""


def sample() -> list[str]:
    """Return those lines of the page that one seed makes."""
    lines = ["| item | measured | verdict |", "|---|---|---|"]
    for name, labels in SAMPLED.items():
        checks = {entry.label: entry.check for entry in PAPERS[name].entries}
        for label in labels:
            result = checks[label](1)
            lines.append(f"| {name}, {label} | {result.measured} | {result.verdict} |")
    return lines


def main() -> None:
    """Run all publications and write the page."""
    args = common.parse(common.parser(__doc__, seeds=4))
    seeds = counted(args.seeds)
    lines = INTRODUCTION.format(origin=args.origin, seeds=seeds, count=args.seeds).splitlines()
    verdicts: dict[str, int] = {}
    for paper in PAPERS.values():
        results = []
        for entry in paper.entries:
            results.append((entry, entry.check(args.seeds)))
            verdict = results[-1][1].verdict
            verdicts[verdict] = verdicts.get(verdict, 0) + 1
            print(f"{paper.name}: {entry.label}: {results[-1][1].measured}", flush=True)
        lines += ["", f"## {paper.reference}", "", *summary_lines(results)]
        for entry, result in results:
            if result.details:
                lines += [
                    "",
                    f"### {entry.label[0].upper()}{entry.label[1:]}",
                    "",
                    *result.details,
                ]
    total = ", ".join(f"{count} {name}" for name, count in sorted(verdicts.items()))
    lines += ["", "## In all", "", f"{sum(verdicts.values())} items: {total}. None is open."]
    lines += common.sample_section(sample())
    common.write_page(args.out / PAGE, lines)


if __name__ == "__main__":
    main()
