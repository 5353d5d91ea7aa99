"""How Sphinx builds the site: `make docs`."""

from __future__ import annotations

import re

from sphinx.application import Sphinx

import failuretwin

project = "failuretwin"
author = "The failuretwin developers"
copyright = "2026, the failuretwin developers"
release = version = failuretwin.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_click",
]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]

html_theme = "furo"
html_title = f"failuretwin {version}"
html_show_sourcelink = False

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_mock_imports = ["sklearn", "torch"]  # too large for pages that only name them
autosummary_generate = False
napoleon_numpy_docstring = False

OUTSIDE = {"../CHANGELOG.md": "changelog.md", "../benchmarks/looks.md": "looks.md"}
"""Pages of the site that show files outside of its folder."""


def link_inside(app: Sphinx, page: str, source: list[str]) -> None:
    """Point links to files outside of the folder at the pages that show them."""
    del app, page
    for outside, inside in OUTSIDE.items():
        source[0] = re.sub(rf"\]\({re.escape(outside)}", f"]({inside}", source[0])


def setup(app: Sphinx) -> None:
    """Tell Sphinx of it."""
    app.connect("source-read", link_inside)
