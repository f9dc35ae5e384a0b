"""The option `--drive ERA=HZ[@LEVEL[:PHASE_DEG]]`."""

import math
import re
from collections.abc import Sequence

from model.errors import InputError, expect_between
from model.rig.rig import Rig
from model.vibration import Excitation, Tone
from registry.plugins import did_you_mean

_NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d{1,2})?"


_DRIVE = re.compile(
    rf"(?P<era>[^=]+)=\s*(?P<frequency>{_NUMBER})\s*"
    rf"(@\s*(?P<level>{_NUMBER})\s*(:\s*(?P<phase>{_NUMBER}))?)?",
    re.IGNORECASE,
)


_NUMBERS = {"frequency": "", "level": "1", "phase": "0"}
"""Groups of `_DRIVE` that are numbers, and their defaults."""


def parse_drives(texts: Sequence[str], rig: Rig) -> Excitation:
    """Parse drives such as `SW=110`, `NE=250@0.5` or `NE=250@0.5:90` to an excitation.

    The level is 1, full stroke, and the phase 0 where they are left out. Raises InputError.
    """
    excitation: dict[str, Tone] = {}
    names = [era.name for era in rig.eras]
    for text in texts:
        match = _DRIVE.fullmatch(text.strip())
        if match is None:
            raise InputError(
                f"--drive must be ERA=HZ[@LEVEL[:PHASE_DEG]], in hertz, share of full stroke and "
                f"degrees without a unit, got {text!r}; for instance {names[0]}=110 or "
                f"{names[0]}=110@0.5:90"
            )
        name = match["era"]
        if name not in names:
            raise InputError(
                f"--drive {text!r}: the rig has no ERA {name!r}; "
                f"{did_you_mean(name, names)}it has {', '.join(names)}"
            )
        if name in excitation:
            raise InputError(f"--drive {text!r}: ERA {name} must have one tone, got two")
        frequency, level, phase = (
            float(match[key] or default) for key, default in _NUMBERS.items()
        )
        expect_between(level, 0, 1, what=f"--drive {text!r}: level")
        if frequency <= 0:
            raise InputError(f"--drive {text!r}: frequency must be positive, got {frequency:g} Hz")
        stroke = rig.full_levels[name]
        excitation[name] = Tone(frequency, level * stroke, math.radians(phase))
    return excitation


def beyond_limits(excitation: Excitation, rig: Rig) -> str | None:
    """Return a warning if tones are outside the rig's frequency limits, else None."""
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    beyond = [
        f"{era} at {tone.frequency:g} Hz"
        for era, tone in excitation.items()
        if not low <= tone.frequency <= high
    ]
    if not beyond:
        return None
    return (
        f"{', '.join(beyond)}: outside the rig's limits.frequency of {low:g} to {high:g} Hz; the "
        "guard enforces this range"
    )
