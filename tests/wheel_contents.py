"""A wheel against the tree, file by file: `python tests/wheel_contents.py WHEEL`."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NAME = "factorgraph_dvl"


def tracked() -> set[str]:
    """Return the files of the package that the repository has, those behind links included."""
    listed = subprocess.run(
        ["git", "ls-files", NAME], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    out = set()
    for name in listed:
        path = ROOT / name
        # A linked folder stands for its files; folders below it are examples.
        inside = (f"{name}/{p.name}" for p in path.glob("*.yaml")) if path.is_dir() else (name,)
        out |= set(inside)
    return out


def differences(packed: Iterable[str]) -> list[str]:
    """Return what is missing in a wheel with these files, and what it should not have."""
    found = {name for name in packed if ".dist-info/" not in name}
    wanted = tracked()
    missing = [f"missing: {name}" for name in sorted(wanted - found)]
    return missing + [f"not in the tree: {name}" for name in sorted(found - wanted)]


if __name__ == "__main__":
    with zipfile.ZipFile(sys.argv[1]) as wheel:
        wrong = differences(wheel.namelist())
    print("\n".join(wrong) or f"the wheel holds the {len(tracked())} files of the tree")
    sys.exit(bool(wrong))
