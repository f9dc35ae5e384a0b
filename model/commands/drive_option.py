"""The option `--drive ERA=HZ[@LEVEL[:PHASE_DEG]]`."""

import math
import re
from collections.abc import Sequence

from model.errors import InputError
from model.rig.rig import Rig
from model.vibration.excitation import Excitation, Tone
from registry.suggestions import did_you_mean

_FORM = re.compile(r"(?P<era>[^=]+)=(?P<frequency>[^@:]+)(?:@(?P<level>[^:]+)(?::(?P<phase>.+))?)?")


def parse_drives(texts: Sequence[str], rig: Rig) -> Excitation:
    """Excitation from drives such as `SW=110`, `NE=250@0.5` or `NE=250@0.5:90`.

    Level 1, full stroke, and phase 0 where they are not given. Raises InputError.
    """
    excitation: dict[str, Tone] = {}
    names = [era.name for era in rig.eras]
    for text in texts:
        match = _FORM.fullmatch(text.strip())
        if match is None:
            raise InputError(
                f"--drive must be ERA=HZ[@LEVEL[:PHASE_DEG]], got {text!r}; for instance "
                f"{names[0]}=110 or {names[0]}=110@0.5:90"
            )
        name = match["era"]
        if name not in names:
            raise InputError(
                f"--drive {text!r}: the rig has no ERA {name!r}; "
                f"{did_you_mean(name, names)}it has {', '.join(names)}"
            )
        if name in excitation:
            raise InputError(f"--drive {text!r}: ERA {name} must have one tone, got two")
        frequency = _number(match["frequency"], text, what="frequency")
        level = _number(match["level"] or "1", text, what="level")
        phase = _number(match["phase"] or "0", text, what="phase")
        if not 0 <= level <= 1:
            raise InputError(f"--drive {text!r}: level must be between 0 and 1, got {level:g}")
        if frequency <= 0:
            raise InputError(f"--drive {text!r}: frequency must be positive, got {frequency:g} Hz")
        stroke = rig.era(name).full_level
        excitation[name] = Tone(frequency, level * stroke, math.radians(phase))
    return excitation


def beyond_limits(excitation: Excitation, rig: Rig) -> str | None:
    """Return a warning if tones are outside the rig's frequency limits."""
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


def _number(text: str, drive: str, *, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(
            f"--drive {drive!r}: {what} must be a finite number, got {text!r}, in hertz, "
            "share of full stroke and degrees without a unit"
        )
    return value
