"""How Sphinx builds these pages; `make docs` does it, with warnings as errors."""

import re
from importlib.metadata import version as version_of

from sphinx.application import Sphinx

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
    """Keep decisions and measured figures out of the side bar, and decisions out of the search."""
    metadata = app.env.metadata[app.env.docname]
    if app.env.docname.startswith(("decisions/", "measured/")):
        metadata["orphan"] = True
    if app.env.docname.startswith("decisions/"):
        metadata["nosearch"] = True


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-signature", _shorten)
    app.connect("doctree-read", _leave_out)
