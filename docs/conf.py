"""How Sphinx builds these pages; `make docs` does it, with warnings as errors."""

from importlib.metadata import version as version_of

project = "era-haptics"
project_copyright = "the era-haptics developers"
release = version = version_of("era-haptics")

extensions = ["myst_parser", "sphinx-mathjax-offline"]
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 4
exclude_patterns = ["_build"]
root_doc = "index"

html_theme = "furo"
html_title = "era-haptics"
html_static_path = []
html_show_sphinx = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b5cad", "color-brand-content": "#0b5cad"},
    "dark_css_variables": {"color-brand-primary": "#6db3ff", "color-brand-content": "#6db3ff"},
}

# Everything a page loads lies beside it: docs are read where there is no network, too.
intersphinx_mapping: dict[str, tuple[str, str | None]] = {}
