"""Settings of Sphinx. All files that a page loads are in the built folder: theme, search, formulas and pictures."""

from importlib import import_module
from pathlib import Path

from sphinx.application import Sphinx

import vijax
from docs import docstrings, generated

project = "vijax"
version = release = vijax.__version__
author = copyright = "the authors of vijax"

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
exclude_patterns = ["build", "outputs", "generated"]

# `executed.read` reads each page and adds the stored outputs to its code cells.
nb_custom_formats = {".md": ["docs.executed.read", {}, False]}
nb_execution_mode = "off"
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3

autodoc_typehints = "none"  # docstrings state shapes, units and ranges; annotations of arrays are too long
autodoc_member_order = "bysource"
napoleon_custom_sections = [("Attributes", "params_style")]  # a record is constructed from its fields
highlight_language = "none"  # indented blocks are command lines of a shell
default_role = "code"  # single backticks in docstrings
smartquotes = False  # an option begins with two hyphens

html_theme = "furo"
html_title = "vijax"
html_show_sphinx = False
html_copy_source = False
# MathJax in one file with its fonts as paths of SVG; the package's other files are not needed.
_MATHJAX = Path(str(import_module("sphinx-mathjax-offline").__file__)).parent / "static/mathjax/tex-svg.js"
html_static_path = ["static", str(_MATHJAX)]
html_css_files = ["pages.css"]
mathjax_path = "tex-svg.js"
html_show_sourcelink = False


def setup(app: Sphinx) -> None:
    """Write the generated parts of pages before Sphinx reads the pages."""
    app.connect("builder-inited", lambda _: generated.write())
    docstrings.setup(app)
