# SPDX-License-Identifier: Apache-2.0
"""The documentation site: Sphinx with MyST pages.  `make docs` builds it without the network."""

from pathlib import Path

from docutils.nodes import SkipNode
from latex2mathml.converter import convert

from abyssnav.version import __version__

project = "abyssnav"
author = "abyssnav developers"
copyright = "abyssnav developers, Apache-2.0"  # noqa: A001  # the name is Sphinx's
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["notebooks"]
nitpicky = False
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
#: Files of the root that pages link to, as a forge shows them, and the pages that include them.
ROOT_PAGES = {"CHANGELOG": "changelog", "CONTRIBUTING": "contributing", "SECURITY": "security"}

html_theme = "furo"
html_title = "abyssnav"
html_static_path: list[str] = []
html_show_sourcelink = False
html_copy_source = False
html_math_renderer = "mathml"  # browsers draw it by themselves; MathJax would come over the net

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_mock_imports: list[str] = []
napoleon_numpy_docstring = True
napoleon_google_docstring = False


def _inline(self, node) -> None:
    self.body.append(convert(node.astext()))
    raise SkipNode


def _block(self, node) -> None:
    style = "overflow-x: auto; overflow-y: hidden; padding: 0.5em 0"
    self.body.append(f'<div style="{style}">{convert(node.astext(), display="block")}</div>')
    raise SkipNode


def _lead_to_pages(_app, docname: str, source: list[str]) -> None:
    """Links to files of the root lead to the pages that include them; patterns match something."""
    up = "../" * docname.count("/")
    for file, page in ROOT_PAGES.items():
        source[0] = source[0].replace(f"]({up}../{file}.md", f"]({up}project/{page}.md")
    if docname == "index":
        lines = source[0].split("\n")
        pages = Path(__file__).parent
        source[0] = "\n".join(x for x in lines if not x.endswith("*") or any(pages.glob(f"{x}.md")))


def setup(app) -> None:
    """Draw formulas as MathML; let links work on a forge and on the site."""
    app.connect("source-read", _lead_to_pages)
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
