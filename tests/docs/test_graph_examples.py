"""Examples for GTSAM scripts of one's own."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_gtsams_optimiser_calibrates_as_solve_does(monkeypatch, capsys):
    script = ROOT / "examples" / "gtsam_calibration.py"
    body = [
        line for line in script.read_text(encoding="utf-8").split('"""')[2].splitlines() if line
    ]
    assert len(body) <= 30
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(script), run_name="__main__")
    apart = [float(x) for x in re.findall(r"differs by (\S+) σ", capsys.readouterr().out)]
    assert len(apart) == 3
    assert max(apart) < 0.01


def test_the_graph_without_imu_is_printed_kind_by_kind(monkeypatch, capsys):
    script = ROOT / "examples" / "graph_without_imu.py"
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(script), run_name="__main__")
    *lines, last = capsys.readouterr().out.splitlines()
    kinds = {}
    for line in lines:
        count, keys, names = re.fullmatch(r" *(\d+) × ([^:]+): (.*)", line).groups()
        kinds[names] = int(count), keys.split()
    assert [kinds[name][0] for name in ("attitude", "turn rates", "track")] == [1, 1, 1]
    steps = kinds["attitude, turn rates, track"]
    assert steps[0] > 100
    assert steps[1] == ["r0", "w0", "r1", "w1", "x0", "x1"]
    measured = {names: count for names, (count, _) in kinds.items() if "time_offset_s" in names}
    assert sorted(measured.values())[-1] > 4 * sorted(measured.values())[0]
    assert sum("misalignment_deg" in names for names in measured) >= 1
    error, cost = (float(x) for x in re.findall(r"\d[\d.]*", last))
    assert error > cost
