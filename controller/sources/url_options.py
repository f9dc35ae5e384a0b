"""Options at the end of a touch source's URL."""

import math
from urllib.parse import parse_qsl


def number_option(options: str, name: str, *, default: float) -> float:
    """Return the number of the only option that there may be; NaN for anything else."""
    given = dict(parse_qsl(options, keep_blank_values=True))
    text = given.pop(name, str(default))
    try:
        return math.nan if given else float(text)
    except ValueError:
        return math.nan
