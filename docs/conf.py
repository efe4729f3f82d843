"""Settings of Sphinx. Whatever a page loads is served from the built folder: theme, search, formulas and pictures."""

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

# Every page is read by `executed.read`, which gives its code cells the outputs that are kept of them.
nb_custom_formats = {".md": ["docs.executed.read", {}, False]}
nb_execution_mode = "off"
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3

autodoc_typehints = "none"  # docstrings tell shapes, units and ranges; the annotations of arrays would drown them
autodoc_member_order = "bysource"
napoleon_custom_sections = [("Attributes", "params_style")]  # a record is made of its fields
highlight_language = "none"  # of indented blocks, which are lines of a shell
default_role = "code"  # what docstrings put into single backticks
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
    """Write what pages show of the program itself before they are read."""
    app.connect("builder-inited", lambda _: generated.write())
    docstrings.setup(app)
