"""How Sphinx builds the site: ``sphinx-build -W docs site``."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from pytest_twin import __version__

HERE = Path(__file__).parent

project = "pytest-twin"
copyright = "the pytest-twin maintainers, Apache-2.0"
version = release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["README.md"]
html_theme = "furo"
html_title = f"pytest-twin {__version__}"
html_static_path: list[str] = []
html_theme_options = {"source_directory": "docs/"}
templates_path: list[str] = []

myst_enable_extensions = ["colon_fence", "deflist"]
# Links of the form page.md#heading are checked: a wrong one fails the build.
myst_heading_anchors = 4
autodoc_member_order = "bysource"
# Each page copies the whole table of contents: with every method in it the build takes a third
# longer.
toc_object_entries = False
# Attributes stand in the class's own docstring.
napoleon_use_ivar = True
napoleon_attr_annotations = False
napoleon_custom_sections = [("Class attributes", "Attributes"), ("Traits", "Attributes")]
# Terminal output is no language, and a lexer's guess colours it at random.
highlight_language = "none"

_spec = importlib.util.spec_from_file_location("reference_pages", HERE / "reference_pages.py")
assert _spec is not None
assert _spec.loader is not None
_pages = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_pages)
# The reference is written from the installed code at each build and kept out of version control.
_pages.write(HERE / "reference" / "generated")
