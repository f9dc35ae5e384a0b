"""Drives in hertz, fractions of full stroke and degrees, and their conversion to excitations."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import TypeAlias

from model.answer.answer import Answer, Layer
from model.arguments import expect_number, shown
from model.errors import InputError
from model.rig.rig import Rig
from model.vibration.excitation import Excitation, Tone


@dataclass(frozen=True)
class Drive:
    """The drive of one ERA: frequency [Hz], level (0..1 of its full stroke), phase [degrees].

    Raises InputError for a frequency of zero or less and a level outside 0..1.
    """

    frequency: float
    level: float = 1.0
    phase_deg: float = 0.0

    def __post_init__(self) -> None:
        """Check types and ranges."""
        for key in ("frequency", "level", "phase_deg"):
            if not isinstance(getattr(self, key), Real):
                raise InputError(
                    f"{key} of a drive must be a number, in hertz, fraction of full stroke or "
                    f"degrees, got {getattr(self, key)!r}"
                )
        if not (0 < self.frequency < math.inf):
            raise InputError(
                f"frequency of a drive must be positive and finite, got {self.frequency} Hz"
            )
        if not 0 <= self.level <= 1:
            raise InputError(
                f"level of a drive must be 0 (silence) to 1 (full stroke), got {self.level}"
            )
        if not math.isfinite(self.phase_deg):
            raise InputError(f"phase of a drive must be finite, got {self.phase_deg} degrees")


_UNITS_OF_A_TONE = {"frequency": "hertz", "amplitude": "metres", "phase": "radians"}

Drives: TypeAlias = Mapping[str, "float | Drive | Tone"]
"""By ERA name: a frequency [Hz] at full stroke, a `Drive`, or a `Tone` [Hz, m, rad]."""

Played: TypeAlias = Answer | Layer | Drives
"""What ERAs are to play: an answer of one layer, a layer, or drives."""


def layer_of(drive: Answer | Layer) -> Layer:
    """The layer, the only one of an answer; raises InputError for an answer with several."""
    if isinstance(drive, Layer):
        return drive
    if len(drive.layers) != 1:
        raise InputError(
            f"an answer must have one layer to be a drive, got {len(drive.layers)}; give one of "
            "its layers"
        )
    return drive.layers[0]


def excitation_of(drive: Played, rig: Rig) -> Excitation:
    """A tone for each ERA; raises InputError for an unknown ERA."""
    if isinstance(drive, Answer | Layer):
        return layer_of(drive).excitation
    if not isinstance(drive, Mapping):
        raise InputError(
            "drive must be an answer, a layer or a mapping of names of ERAs, such as "
            f'{{"SW": 110}}, got {shown(drive)}'
        )
    tones = {}
    for name, given in drive.items():
        if name not in rig.wiring:
            raise InputError(f"unknown ERA {name!r}; known are {', '.join(rig.wiring)}")
        if isinstance(given, Tone):
            for key, unit in _UNITS_OF_A_TONE.items():
                expect_number(getattr(given, key), what=f"{key} of the tone of {name}", unit=unit)
            tones[name] = given
            continue
        one = given if isinstance(given, Drive) else Drive(given)
        amplitude = float(one.level) * rig.era(name).stroke
        tones[name] = Tone(float(one.frequency), amplitude, math.radians(one.phase_deg))
    return tones
