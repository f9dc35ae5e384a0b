"""A drive as people write it, in hertz, shares of full stroke and degrees, as physics."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import TypeAlias

from model.arguments import expect_number, shown
from model.errors import InputError
from model.rig.rig import Rig
from model.table.pattern import Pattern
from model.vibration.excitation import Excitation, Tone


@dataclass(frozen=True)
class Drive:
    """What one ERA plays: frequency [Hz], level (0..1 of its full stroke) and phase [degrees].

    Raises InputError for a frequency that is not above zero and a level outside 0..1.
    """

    frequency: float
    level: float = 1.0
    phase_deg: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what nothing can play."""
        for key in ("frequency", "level", "phase_deg"):
            if not isinstance(getattr(self, key), Real):
                raise InputError(
                    f"{key}={getattr(self, key)!r} of a drive is no number; hertz, a share of the "
                    "full stroke and degrees are plain numbers here"
                )
        if not (0 < self.frequency < math.inf):
            raise InputError(f"a drive of {self.frequency} Hz is none; give one above zero")
        if not 0 <= self.level <= 1:
            raise InputError(
                f"a level of {self.level} is none; 1 is the ERA's full stroke, 0 is silence"
            )
        if not math.isfinite(self.phase_deg):
            raise InputError(f"a phase of {self.phase_deg} degrees is none; give a finite number")


_UNITS_OF_A_TONE = {"frequency": "hertz", "amplitude": "metres", "phase": "radians"}

Drives: TypeAlias = Mapping[str, "float | Drive | Tone"]
"""By the ERA's name: a frequency [Hz] at full stroke, a `Drive`, or a `Tone` [Hz, m, rad]."""


def excitation_of(drive: Pattern | Drives, rig: Rig) -> Excitation:
    """The same as a tone for each ERA; raises InputError for an ERA that the rig has not."""
    if isinstance(drive, Pattern):
        return drive.excitation
    if not isinstance(drive, Mapping):
        raise InputError(
            f"drive is {shown(drive)}; give a pattern, or what each ERA plays by its name, such as "
            '{"SW": 110}'
        )
    tones = {}
    for name, told in drive.items():
        if name not in rig.wiring:
            raise InputError(f"the rig has no ERA {name!r}, only {', '.join(rig.wiring)}")
        if isinstance(told, Tone):
            for key, unit in _UNITS_OF_A_TONE.items():
                expect_number(getattr(told, key), what=f"{key} of the tone of {name}", unit=unit)
            tones[name] = told
            continue
        asked = told if isinstance(told, Drive) else Drive(told)
        amplitude = float(asked.level) * rig.era(name).stroke
        tones[name] = Tone(float(asked.frequency), amplitude, math.radians(asked.phase_deg))
    return tones
