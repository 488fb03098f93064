"""What is installed: all files of the package that the repository has, and no others."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys

import pytest
from wheel_contents import NAME, ROOT, differences, tracked


def test_what_is_built_is_what_the_tree_has(tmp_path):
    pytest.importorskip("setuptools")
    if not (ROOT / ".git").exists():
        pytest.skip("not in a checkout")
    tree, built = tmp_path / "tree", tmp_path / "built"
    for name in tracked():
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tree / name)
    # What is packed, without the metadata, which an older setuptools may not know.
    settings = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    packing = re.findall(
        r"^\[tool\.setuptools.*?(?=^\[(?!tool\.setuptools))", settings, re.M | re.S
    )
    project = '[project]\nname = "factorgraph-dvl"\nversion = "0"\n'
    (tree / "pyproject.toml").write_text(project + "".join(packing), encoding="utf-8")
    # What lies about in a checkout is not packed.
    (tree / NAME / "notes.txt").write_text("")
    (tree / "tests").mkdir()
    (tree / "tests" / "__init__.py").write_text("")
    build = "from setuptools import setup; setup()"
    subprocess.run(
        [sys.executable, "-W", "ignore", "-c", build, "-q", "build", "--build-lib", str(built)],
        cwd=tree,
        check=True,
        capture_output=True,
    )
    packed = [p.relative_to(built).as_posix() for p in built.rglob("*") if p.is_file()]
    assert differences(packed) == []


def test_a_file_too_many_and_one_too_few_are_named():
    names = tracked()
    left_out = next(iter(sorted(names)))
    assert differences((names - {left_out}) | {f"{NAME}/notes.txt", "x.dist-info/METADATA"}) == [
        f"missing: {left_out}",
        f"not in the tree: {NAME}/notes.txt",
    ]
