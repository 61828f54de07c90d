"""Sphinx configuration."""

import re

from latex2mathml.converter import convert

project = "imulab"
copyright = "2026, the imulab maintainers"
author = "the imulab maintainers"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
source_suffix = {".md": "myst-nb", ".ipynb": "myst-nb"}
# Notebooks and the gallery are stored without outputs, which are large and change with every run; the build makes them.
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_timeout = 120
nb_execution_raise_on_error = True
nb_merge_streams = True
suppress_warnings = ["mystnb.unknown_mime_type"]  # a figure's JSON, beside its HTML
exclude_patterns = ["_build", "**.ipynb_checkpoints"]
smartquotes = False  # two hyphens begin an option
html_theme = "furo"
html_title = "imulab"
myst_heading_anchors = 2
html_math_renderer = "mathml"
html_static_path = ["static"]
html_css_files = ["imulab.css"]
autodoc_typehints = "none"
napoleon_numpy_docstring = True


def _mathml(display):
    """Return a visitor that writes a formula as MathML, which browsers show by themselves, without a network."""

    def visit(self, node):
        from docutils.nodes import SkipNode

        formula = convert(node.astext(), display="block" if display else "inline")
        unknown = re.search(r"\\[A-Za-z]+", formula)
        if unknown:
            raise ValueError(f"formula {node.astext()!r}: {unknown.group()} is not understood")
        self.body.append(f'<div class="formula">{formula}</div>' if display else formula)
        raise SkipNode

    return visit


def setup(app):
    """Let formulas be drawn by the browser."""
    app.add_html_math_renderer("mathml", (_mathml(False), None), (_mathml(True), None))
