"""How Sphinx builds this documentation: ``python -m sphinx -W docs docs/_build``."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx

import cv_densityf

project = "cv-densityf"
version = release = cv_densityf.__version__

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["_build", "examples", "gallery/*.ipynb", "gallery/*.py"]
nitpicky = True
default_role = "py:obj"  # the single backticks of the docstrings
nitpick_ignore_regex = [("py:obj", r"(numpy|sklearn)\..*")]  # other people's pages
templates_path = ["_templates"]
smartquotes = False  # x' is no quotation

myst_heading_anchors = 3
copybutton_exclude = ".linenos, .gp, .go"

autosummary_generate = True
autodoc_typehints = "none"  # numpydoc's sections tell types, shapes and ranges
numpydoc_show_class_members = False

sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "gallery",
    "doc_module": "cv_densityf",
    "reference_url": {"cv_densityf": None},
    "backreferences_dir": "gallery/backreferences",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "show_signature": False,
    "capture_repr": ("_repr_html_", "__repr__"),
    "ignore_repr_types": "matplotlib",
    "write_computation_times": False,
}

html_theme = "pydata_sphinx_theme"
html_title = "cv-densityf"
html_show_copyright = False
html_theme_options = {
    "navbar_center": [],
    "pygments_light_style": "default",
    "pygments_dark_style": "github-dark",
    "footer_start": [],
    "footer_end": [],
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
}
html_sidebars = {"**": ["sidebar-all"]}
html_show_sourcelink = False
html_static_path = ["_static"]
html_css_files = ["site.css"]


def hide_constructor(app: Sphinx, what: str, name: str, obj: Any, *_: Any) -> Any:
    """Leave out the signatures of results, which nobody makes by hand."""
    return ("", None) if what == "class" and dataclasses.is_dataclass(obj) else None


def link_gallery(app: Sphinx, page: str, source: list[str]) -> None:
    """Let links to examples lead to their gallery pages: without Sphinx they lead to the code."""
    source[0] = re.sub(r"\(examples/(plot_\w+)\.py\)", r"(gallery/\1.rst)", source[0])


def find_by_last_part(app: Sphinx, env: Any, node: Any, text: nodes.TextElement) -> Any:
    """Let docstrings name things of this package without the module they are in."""
    if node.get("reftype") != "obj" or node.get("refspecific"):
        return None
    node["refspecific"] = True
    python = env.get_domain("py")
    return python.resolve_xref(
        env, node["refdoc"], app.builder, "obj", node["reftarget"], node, text
    )


def setup(app: Sphinx) -> None:
    """Connect what is not a setting."""
    app.connect("autodoc-process-signature", hide_constructor)
    app.connect("source-read", link_gallery)
    app.connect("missing-reference", find_by_last_part)
