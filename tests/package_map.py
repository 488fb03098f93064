"""The map of the package in CONTRIBUTING.md: run this module to write it anew."""

from __future__ import annotations

import ast
from pathlib import Path

import factorgraph_dvl

PACKAGE = Path(factorgraph_dvl.__file__).parent
DOCUMENT = PACKAGE.parent / "CONTRIBUTING.md"
BEGIN, END = "<!-- map: begin -->", "<!-- map: end -->"


def first_line(path: Path) -> str:
    """Return the first line of a module's docstring."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]


def entries(folder: Path, depth: int = 0) -> list[str]:
    """Return a line for each package and module below a folder."""
    out = []
    packages = sorted(p for p in folder.iterdir() if (p / "__init__.py").exists())
    modules = sorted(p for p in folder.glob("*.py") if not p.stem.startswith("__"))
    for path in modules:
        out.append(f"{'  ' * depth}- `{path.stem}`: {first_line(path)}")
    for path in packages:
        out.append(f"{'  ' * depth}- **`{path.name}/`** {first_line(path / '__init__.py')}")
        out += entries(path, depth + 1)
    return out


def drawn() -> str:
    """Return the map as it should be."""
    return "\n".join([BEGIN, "", *entries(PACKAGE), "", END])


def written() -> str:
    """Return the map as it stands in the document."""
    text = DOCUMENT.read_text(encoding="utf-8")
    return text[text.index(BEGIN) : text.index(END) + len(END)]


if __name__ == "__main__":
    text = DOCUMENT.read_text(encoding="utf-8")
    DOCUMENT.write_text(text.replace(written(), drawn()), encoding="utf-8")
