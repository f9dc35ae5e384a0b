"""Options at the end of a touch source's URL."""

import math
from urllib.parse import parse_qsl


def number_option(options: str, name: str, *, default: float) -> float:
    """Return the number of the only option that there may be; NaN for anything else."""
    asked = dict(parse_qsl(options, keep_blank_values=True))
    text = asked.pop(name, str(default))
    try:
        return math.nan if asked else float(text)
    except ValueError:
        return math.nan
