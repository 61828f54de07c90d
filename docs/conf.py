"""Sphinx configuration."""

project = "imulab"
copyright = "2026, the imulab maintainers"
author = "the imulab maintainers"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "imulab"
autodoc_typehints = "none"
napoleon_numpy_docstring = True
