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
