"""The documentation site: ``pip install ".[docs]" && python -m sphinx -W -b html docs docs/_build/html``, offline."""

import logging
import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

from build_steps import MathML, save_figures, write_commands, write_formulations  # noqa: E402

from optid import __version__  # noqa: E402

project, author, release = "optid", "The optid developers", __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.intersphinx",
              "sphinx_gallery.gen_gallery"]
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "tutorials/*.rst", "**/sg_execution_times.rst", "sg_execution_times.rst"]
html_theme, html_title, html_static_path, html_css_files = "furo", f"optid {release}", ["static"], ["site.css"]
html_math_renderer = "mathml"
napoleon_use_ivar, napoleon_numpy_docstring = True, False
autodoc_typehints, autodoc_member_order = "signature", "bysource"
autodoc_default_options = {"members": True, "show-inheritance": False}
suppress_warnings = ["config.cache", "ref.python"]  # a function in the settings; attributes of one name in two classes
sphinx_gallery_conf = {
    "examples_dirs": [str(HERE / "tutorials")],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"\.py$",
    "image_scrapers": (save_figures,),
    "capture_repr": ("_repr_html_", "__repr__"),
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "min_reported_time": 1e9,
}
# the object inventories of other projects need the network: python -m sphinx with OPTID_DOCS_ONLINE=1 links to them
intersphinx_mapping = {} if not os.environ.get("OPTID_DOCS_ONLINE") else {
    "python": ("https://docs.python.org/3", None), "numpy": ("https://numpy.org/doc/stable", None),
    "scipy": ("https://docs.scipy.org/doc/scipy", None), "cvxpy": ("https://www.cvxpy.org", None)}


def setup(app):
    """Write the generated pages, and render formulas without a script."""
    logging.getLogger("optid").setLevel(logging.WARNING)  # the log of a search is no part of its tutorial
    write_commands(HERE / "generated")
    write_formulations(HERE / "generated")
    app.add_html_math_renderer("mathml", inline_renderers=(MathML.inline, None), block_renderers=(MathML.block, None))
