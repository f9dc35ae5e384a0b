"""Options at the end of a touch source's URL."""

import math
from urllib.parse import parse_qsl

from controller.sources.slots import ABS_MT_PRESSURE, ABS_MT_TOUCH_MAJOR

_LIGHT_PRESS = {"light_pressure": ABS_MT_PRESSURE, "light_major": ABS_MT_TOUCH_MAJOR}


def number_option(options: str, name: str, *, default: float) -> float:
    """Return the number of the only option that there may be; NaN for anything else."""
    given = dict(parse_qsl(options, keep_blank_values=True))
    text = given.pop(name, str(default))
    try:
        return math.nan if given else float(text)
    except ValueError:
        return math.nan


def panel_options(options: str) -> tuple[dict[str, str], dict[int, float]]:
    """Split the options of a panel: others, and `light_pressure` and `light_major` by axis.

    These are the values of the axes under a finger that presses lightly; one that is no number of
    at least 0 is among the others.
    """
    others, by_axis = dict(parse_qsl(options, keep_blank_values=True)), {}
    for name, axis in _LIGHT_PRESS.items():
        value = number_option(f"{name}={others[name]}", name, default=0) if name in others else -1
        if 0 <= value < math.inf:
            by_axis[axis] = value
            del others[name]
    return others, by_axis
