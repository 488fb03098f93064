"""Site of the documentation: `sphinx-build -W docs out/site`. It needs no network.

The pages are plain Markdown that a code host shows as they are; this file adds search, the
reference of the functions and the gallery of examples.
"""

import re
from importlib.metadata import version as version_of
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).parent.parent

project = "factorgraph_dvl"
author = "the authors of factorgraph_dvl"
release = version_of("factorgraph-dvl")

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx_gallery.gen_gallery",
]
# Times of examples that are not run, with a table that loads scripts from elsewhere.
exclude_patterns = ["**/sg_execution_times.rst", "sg_execution_times.rst"]
templates_path = ["_templates"]

html_theme = "pydata_sphinx_theme"
html_title = project
html_static_path = ["_static"]
html_css_files = ["site.css"]
# Pages without pages below them need no list of these.
html_sidebars = {
    name: [] for name in ("getting-started", "getting-started.zh", "glossary", "comparison")
}
html_theme_options = {"show_toc_level": 2}
html_show_sourcelink = False
html_copy_source = False
# Code without a language, such as equations in plain text, is no Python.
highlight_language = "text"

myst_enable_extensions = ["dollarmath"]
# Equations as code hosts draw them too.
myst_fence_as_directive = ["math"]
# Links to headings work down to this level.
myst_heading_anchors = 4

# Equations as SVG: the one file has all glyphs and extensions, nothing is loaded beside it.
mathjax_path = "vendor/mathjax-3.2.2/tex-svg-full.js"
mathjax3_config = {"options": {"enableMenu": False}}

autodoc_typehints = "none"
autosummary_generate = True
numpydoc_show_class_members = False

# Scripts are shown, not run: tests run them.
sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "plot_gallery": False,
    "within_subsection_order": "FileNameSortKey",
    "default_thumb_file": str(ROOT / "docs" / "images" / "calibration.png"),
    "ignore_pattern": r"crosscheck",
    "download_all_examples": False,
    "show_memory": False,
    "remove_config_comments": True,
}


def follow_links_out_of_docs(app: Sphinx, docname: str, content: list[str]) -> None:
    """Lead links to examples to the gallery; replace those to what the site lacks by names."""

    def named(link: re.Match[str]) -> str:
        text, path = link.groups()
        folder = ROOT / path
        if path.startswith("examples") and (path.endswith(".py") or any(folder.glob("GALLERY_*"))):
            page = path.replace("examples", "/gallery", 1)
            page = page.removesuffix(".py") if page.endswith(".py") else f"{page}/index"
            return f"{{doc}}`{text.replace('`', '')} <{page}>`"
        if (ROOT / path).is_file() and not path.endswith(".md"):
            # Sphinx copies other files into the site.
            return link[0]
        return text if path in text else f"{text} (`{path}` in the repository)"

    content[0] = re.sub(r"\[([^\]]*)\]\(\.\./([^)#]*)(?:#[^)]*)?\)", named, content[0])


def setup(app: Sphinx) -> None:
    """Connect the above."""
    app.connect("source-read", follow_links_out_of_docs)
