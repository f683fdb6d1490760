"""Configuration of the documentation site; ``make docs`` builds it, offline.

Sphinx with furo, since Stable-Baselines3's own documentation is that: its readers know it, ``:param:`` docstrings like ours
render as they are, and pages stay Markdown.

The source folder is the repository, not ``docs/``. So a relative link or picture of a page means the same on GitHub and on
the site, where pages of the repository become pages, pictures are copied, and any other file can be downloaded.
"""

import re
import sys
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.util import logging

logger = logging.getLogger(__name__)
ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

project = "sb3_crc"
author = "The sb3_crc contributors"
root_doc = "docs/index"
# Without what is excluded, Sphinx would look for pages in .venv and in the logs of runs
include_patterns = ["docs/**.md", "results/*/README.md", "README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"]
exclude_patterns = [
    *(path.name for path in ROOT.iterdir() if path.is_dir() and path.name not in ("docs", "results")),
    "docs/_build",
]

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
]
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3  # links like page.md#heading, as on GitHub
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the text says shapes and units, which types do not
copybutton_exclude = ".linenos, .gp, .go"

html_theme = "furo"
html_title = "sb3_crc"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_extra_path = ["_root"]  # an index.html that leads to docs/index.html
html_copy_source = False
html_show_sourcelink = False
html_math_renderer = "mathml"


# -- Equations ---------------------------------------------------------------------------------------------------------
# As MathML, made by docutils: browsers draw it themselves, so that neither building nor reading needs a network.


def mathml(equation: str, *, as_block: bool = False) -> str:
    """:param equation: LaTeX; :return: MathML. What docutils does not understand is a warning, which ends `make docs`."""
    try:
        return str(tex2mathml(equation, as_block=as_block))
    except MathError as error:
        logger.warning("equation %r: %s", equation, error)
        return f"<code>{escape(equation)}</code>"


def inline_math(translator: Any, node: nodes.math) -> None:
    """Write an equation within a line."""
    translator.body.append(mathml(node.astext()))
    raise nodes.SkipNode


def block_math(translator: Any, node: nodes.math_block) -> None:
    """Write an equation of its own."""
    translator.body.append(f'<div class="math">{mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


# -- Docstrings --------------------------------------------------------------------------------------------------------


def one_field_a_line(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Short docstrings have several fields on a line, ``:param x: this; :return: that``; Sphinx wants a line for each."""
    lines[:] = [part for line in lines for part in re.split(r"[;,.]\s+(?=:(?:param|return|raises)\b)", line)]


# -- Pages that were written for GitHub --------------------------------------------------------------------------------


def one_title(app: Sphinx, doctree: nodes.document) -> None:
    """Of a page with several titles let the first be the page's, and the others its sections."""
    first, *others = [node for node in doctree.children if isinstance(node, nodes.section)] or [None]
    for section in others:
        doctree.remove(section)
        first.append(section)


# -- Links -------------------------------------------------------------------------------------------------------------


def show_source(app: Sphinx, doctree: nodes.document, page: str) -> None:
    """Let links to a module of the package lead to its highlighted source instead of downloading it."""
    documented = getattr(app.env, "_viewcode_modules", {})  # of sphinx.ext.viewcode
    for link in list(doctree.findall(addnodes.download_reference)):
        file = Path(link.get("filename", ""))
        target = Path(app.srcdir, app.env.doc2path(page)).parent.joinpath(link["reftarget"]).resolve()
        if file.suffix != ".py" or not target.is_relative_to(ROOT / "sb3_crc"):
            continue
        module = ".".join(target.relative_to(ROOT).with_suffix("").parts)
        if documented.get(module):
            source = app.builder.get_relative_uri(page, "_modules/" + module.replace(".", "/"))
            link.replace_self(nodes.reference("", "", *link.children, refuri=source, internal=True))


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    ignore: Callable[..., None] = lambda translator, node: None  # noqa: E731
    app.add_html_math_renderer("mathml", (inline_math, ignore), (block_math, ignore))
    app.connect("autodoc-process-docstring", one_field_a_line)
    app.connect("doctree-read", one_title, priority=400)  # before titles are collected
    app.connect("doctree-resolved", show_source)
