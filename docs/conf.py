"""How Sphinx builds these pages; `make docs` does it, with warnings as errors."""

import os
import re
import subprocess
import sys
from importlib.metadata import version as version_of
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

project = "era-haptics"
project_copyright = "the era-haptics developers"
release = version = version_of("era-haptics")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx-mathjax-offline"]
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 4
exclude_patterns = ["_build"]
root_doc = "index"
highlight_language = "text"  # of what names none: what is typed and printed, hardly ever Python

autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = "era-haptics"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b5cad", "color-brand-content": "#0b5cad"},
    "dark_css_variables": {"color-brand-primary": "#6db3ff", "color-brand-content": "#6db3ff"},
}

# Everything a page loads lies beside it: docs are read where there is no network, too.
intersphinx_mapping: dict[str, tuple[str, str | None]] = {}


_ARRAY_TYPE = re.compile(r"~numpy\.ndarray\[.*?~numpy\.dtype\[[^]]*\]\]")
_LONG_ARRAY = re.compile(r"array\(\[([^,]+),.+?, *([^,]+)\]\)")


def _shorten(
    app: Sphinx,
    what: str,
    name: str,
    obj: object,
    options: object,
    signature: str | None,
    gives: str | None,
) -> tuple[str, str | None] | None:
    """Say types by their names; an array's shape stands in the words below."""
    if signature is None:
        return None
    return _LONG_ARRAY.sub(r"[\1, ..., \2]", _named(signature)), gives and _named(gives)


def _named(text: str) -> str:
    """Types that are long by the names they go by."""
    return _ARRAY_TYPE.sub("ndarray", text)


def _leave_out(app: Sphinx, doctree: object) -> None:
    """Keep pages that an index page lists out of the side bar."""
    if app.env.docname.startswith(("gallery/", "measured/")):
        app.env.metadata[app.env.docname]["orphan"] = True


class Notebook(SphinxDirective):
    """`{notebook} FILE`: an example in percent format, run while the page is read."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The nodes of all cells; a notebook that fails is an error of the page."""
        root = Path(__file__).parents[1]
        runner, name = root / "docs" / "generators" / "notebooks.py", self.arguments[0]
        for read in (runner, root / name):
            self.env.note_dependency(str(read))
        ran = subprocess.run(  # noqa: S603  # an example of the project
            [sys.executable, runner, name],
            cwd=root,
            env=os.environ | {"PYTHONPATH": str(root), "OPENBLAS_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
        )
        if ran.returncode:
            raise self.error(f"{name} ended with {ran.returncode}:\n{ran.stderr}")
        return self.parse_text_to_nodes(ran.stdout, allow_section_headings=True)


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-signature", _shorten)
    app.add_directive("notebook", Notebook)
    app.connect("doctree-read", _leave_out)
