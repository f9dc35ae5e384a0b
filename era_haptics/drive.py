"""Drives in hertz, fractions of full stroke and degrees, and their conversion to layers."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import TypeAlias

from model.answer.answer import Answer, Layer
from model.arguments import expect_number, shown
from model.errors import InputError
from model.rig.rig import Rig
from model.vibration.excitation import Tone


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

Driven: TypeAlias = float | Drive | Tone
"""A frequency [Hz] at full stroke, a `Drive`, or a `Tone` [Hz, m, rad]."""

Drives: TypeAlias = Mapping[str, Driven | Sequence[Driven]]
"""By ERA name: what it plays, or several of them at once."""

Played: TypeAlias = Answer | Layer | Drives
"""What ERAs are to play: an answer with all its layers, one layer, or drives."""


def layers_of(drive: Played, rig: Rig) -> tuple[Layer, ...]:
    """The layers of an answer, or one; raises InputError for an unknown ERA, and for silence."""
    if isinstance(drive, Answer | Layer):
        layers = drive.layers if isinstance(drive, Answer) else (drive,)
        if not layers:
            raise InputError("an answer must have a layer to be played, got one of quiet fingers")
        return layers
    if not isinstance(drive, Mapping):
        raise InputError(
            "drive must be an answer, a layer or a mapping of names of ERAs, such as "
            f'{{"SW": 110}}, got {shown(drive)}'
        )
    tones: dict[str, list[Tone]] = {}
    for name, given in drive.items():
        if name not in rig.wiring:
            raise InputError(f"unknown ERA {name!r}; known are {', '.join(rig.wiring)}")
        several = given if isinstance(given, list | tuple) else (given,)
        tones[name] = [_tone_of(one, name, rig) for one in several]
    count = max([1, *map(len, tones.values())])
    excitation, *others = (
        {name: each[number] for name, each in tones.items() if number < len(each)}
        for number in range(count)
    )
    return (Layer(excitation, side_bands=tuple(others)),)


def _tone_of(given: Driven, name: str, rig: Rig) -> Tone:
    """The tone of an ERA; raises InputError for what is none."""
    if isinstance(given, Tone):
        for key, unit in _UNITS_OF_A_TONE.items():
            expect_number(getattr(given, key), what=f"{key} of the tone of {name}", unit=unit)
        return given
    one = given if isinstance(given, Drive) else Drive(given)
    amplitude = float(one.level) * rig.era(name).stroke
    return Tone(float(one.frequency), amplitude, math.radians(one.phase_deg))
