"""Style of a rig's page: colors, settings of figures, and figures as SVG elements."""

import re
from html import escape
from io import StringIO
from typing import Any

from matplotlib.figure import Figure

INK = "#1b2530"
FAINT = "#6b7885"
ACCENT = "#b3400e"
FILL = "#eaf0f5"
BAND = "#c5dde6"
CURVE = "#1b6b85"
SKIN = "#f3c9a9"
SKIN_EDGE = "#8a5a33"
"""Rim of a fingertip."""

_VARIABLES = {
    INK: "var(--ink)",
    FAINT: "var(--faint)",
    ACCENT: "var(--accent)",
    FILL: "var(--fill)",
    BAND: "var(--band)",
    CURVE: "var(--curve)",
}
"""Variables of the page's style sheet, by the color that stands for each in a figure."""

STYLE: dict[str, Any] = {
    "svg.fonttype": "none",  # text can be searched
    "svg.hashsalt": "era",
    "savefig.transparent": True,
    "font.size": 8,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
}
"""Settings of matplotlib while the figures of a page are drawn."""


def svg_of(figure: Figure, words: str) -> str:
    """Return a figure as an element of HTML; words: its description for screen readers."""
    stream = StringIO()
    figure.savefig(stream, format="svg", dpi=150, metadata={"Date": None})
    _, start, element = stream.getvalue().partition("<svg ")
    element = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", element, flags=re.DOTALL)
    element = re.sub(r'<g id="\w+"', "<g", element)  # the same in every figure
    for color, variable in _VARIABLES.items():
        element = element.replace(color, variable)
    return f'{start}role="img" aria-label="{escape(words)}" {element}'
