"""Configuration of Sphinx; `make docs` builds the site."""

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
autodoc_mock_imports = ["sklearn", "torch"]  # too large to install for the site
autosummary_generate = False
napoleon_numpy_docstring = False

OUTSIDE = {"../CHANGELOG.md": "changelog.md", "../benchmarks/looks.md": "looks.md"}
"""Files outside of the folder, and the pages that include them."""


def link_inside(app: Sphinx, page: str, source: list[str]) -> None:
    """Redirect links to files outside of the folder to the pages that include them."""
    del app, page
    for outside, inside in OUTSIDE.items():
        source[0] = re.sub(rf"\]\({re.escape(outside)}", f"]({inside}", source[0])


def setup(app: Sphinx) -> None:
    """Register the hook with Sphinx."""
    app.connect("source-read", link_inside)
