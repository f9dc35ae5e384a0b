"""Arguments of the public functions: checks of rigs, positions, loads and signals, and drives.

A drive is given in hertz, fractions of full stroke and degrees, and converted to layers.
"""

import math
import warnings
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, TypeAlias, cast

import numpy as np

from model.answer.answer import Answer, Layer
from model.answer.stimulus import Finger
from model.arrays import FloatArray, Point
from model.errors import InputError, expect_instance, expect_number, is_whole, shown
from model.rig.rig import Rig
from model.vibration import Tone

Positions: TypeAlias = Sequence[float] | Sequence[Sequence[float]]
"""One position x, y [m], or several; also an array of shape (2,) or (n, 2)."""

Fingers: TypeAlias = Positions | Sequence[Finger]
"""Positions [m] of fingers, or fingers with their loads and bounds."""

MAX_LEVEL = 1 + 1e-9
"""Full stroke, with the rounding of weights that were divided by the largest."""

_MAX_SUM = 1 + 1e-6
"""Highest sum of levels, with the rounding of answers in single precision."""

_UNITS_OF_A_TONE = {
    "frequency": "hertz",
    "amplitude": "meters, or volts of an exciter",
    "phase": "radians",
}


def expect_rig(value: object) -> None:
    """Raise InputError for anything but a rig, such as the name of its file."""
    expect_instance(value, Rig, what="rig", made_by='era.load_rig("rig.yaml")')


def warn_of_surface(rig: Rig) -> None:
    """Warn of suspicious modes of a rig's surface, at the line that called the public function."""
    for note in rig.surface_notes:
        warnings.warn(note, stacklevel=3)


def as_frequencies(value: object) -> FloatArray:
    """Convert to frequencies (f,) [Hz], at least one, in the given order."""
    rule = "frequencies must be a sequence of numbers in hertz, such as range(60, 321, 10)"
    return _row(value, rule, min_count=1)


def as_loads(value: object) -> tuple[float, ...]:
    """Check finger loads for a query; raises InputError for anything but a sequence of numbers."""
    rule = (
        "loads must be a sequence with one number per finger, relative to the rig's fingertip, "
        "such as [1, 1.5]"
    )
    return tuple(_row(value, rule).tolist())


def as_points(positions: Positions, *, what: str) -> tuple[Point, ...]:
    """Check positions for a query; `what` names the argument in the InputError."""
    coordinates = _numbers(positions)
    if coordinates.size == 0:
        return ()
    if coordinates.ndim > 2 or coordinates.shape[-1:] != (2,):
        raise InputError(
            f"{what} must be x, y in meters from the corner SW, such as (0.08, 0.06), or a list of "
            f"such pairs, got {positions!r}"
        )
    return tuple((float(x), float(y)) for x, y in coordinates.reshape(-1, 2))


def as_fingers(value: object, *, what: str) -> tuple[Finger, ...]:
    """Convert to fingers, positions without a stimulus; `what` names the argument in the
    InputError."""
    if not isinstance(value, Sequence) or not any(isinstance(item, Finger) for item in value):
        return tuple(map(Finger, as_points(cast(Positions, value), what=what)))
    fingers = []
    for item in value:
        fingers.append(item if isinstance(item, Finger) else Finger(cast(Point, item)))
    return tuple(fingers)


def as_signals(value: object, rig: Rig, sample_rate: object) -> FloatArray:
    """Check signals of all ERAs (eras, n), 1 = full stroke; raises InputError if an ERA cannot play
    them."""
    expect_number(sample_rate, what="sample_rate", unit="hertz")
    min_rate = 2 * rig.limits.frequency_max
    if not min_rate < cast(float, sample_rate) < math.inf:
        raise InputError(
            f"sample_rate must be above {min_rate:g} Hz, twice the rig's highest frequency, got "
            f"{sample_rate} Hz"
        )
    signals = _numbers(value)
    if signals.ndim != 2 or len(signals) != len(rig.eras) or not signals.size:
        got = f"shape {np.shape(value)}" if isinstance(value, np.ndarray) else shown(value)
        names = ", ".join(era.name for era in rig.eras)
        raise InputError(
            f"signals must be real numbers ({len(rig.eras)}, samples), a row for each ERA, "
            f"{names}, got {got}"
        )
    beyond = np.argwhere(~(np.abs(signals) <= MAX_LEVEL))  # NaN, too
    if len(beyond):
        row, sample = beyond[0].tolist()
        raise InputError(
            f"signals must be within full stroke, -1 to 1, got {signals[row, sample]} of "
            f"{rig.eras[row].name} at sample {sample}"
        )
    return np.clip(signals, -1, 1)


def as_pair(value: object, *, what: str, such_as: str) -> tuple[int, int]:
    """Convert to two integers, also from an array; raises InputError for anything else."""
    pair = tuple(value) if isinstance(value, Sequence | np.ndarray) else ()
    if len(pair) != 2 or not all(is_whole(count) for count in pair):
        raise InputError(f"{what} must be two whole numbers, {such_as}, got {shown(value)}")
    return int(pair[0]), int(pair[1])


def _row(value: object, rule: str, *, min_count: int = 0) -> FloatArray:
    """Convert a sequence of numbers to an array (n,); raises InputError, with `rule` in its
    text."""
    row = _numbers(value)
    if row.ndim != 1 or len(row) < min_count:
        raise InputError(f"{rule}, got {shown(value)}")
    return row


def _numbers(value: Any) -> FloatArray:
    """Convert numbers to an array; anything else becomes a 3-D array, which all callers reject."""
    try:
        if np.iscomplexobj(value):
            raise TypeError
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return np.full((1, 1, 1), np.nan)


@dataclass(frozen=True)
class Drive:
    """An ERA's drive: frequency [Hz], level (0 to 1 of full stroke), phase [degrees].

    Raises InputError if the frequency is not positive or the level is outside 0 to 1.
    """

    frequency: float
    level: float = 1.0
    phase_deg: float = 0.0

    def __post_init__(self) -> None:
        """Check types and ranges."""
        for key in ("frequency", "level", "phase_deg"):
            value = getattr(self, key)
            if not isinstance(value, Real):
                raise InputError(
                    f"{key} of a drive must be a number, in hertz, fraction of full stroke or "
                    f"degrees, got {value!r}"
                )
        if not (0 < self.frequency < math.inf):
            raise InputError(
                f"frequency of a drive must be positive and finite, got {self.frequency} Hz"
            )
        if not 0 <= self.level <= MAX_LEVEL:
            raise InputError(
                f"level of a drive must be 0 (silence) to 1 (full stroke), got {self.level}"
            )
        object.__setattr__(self, "level", min(self.level, 1.0))
        if not math.isfinite(self.phase_deg):
            raise InputError(f"phase of a drive must be finite, got {self.phase_deg} degrees")


Driven: TypeAlias = float | Drive | Tone
"""A frequency [Hz] at full level, a `Drive`, or a `Tone` [Hz; m, or V for an exciter; rad]."""

Drives: TypeAlias = Mapping[str, Driven | Sequence[Driven]]
"""Drives of each ERA, by name: one drive, or several that play simultaneously."""

Played: TypeAlias = Answer | Layer | Drives
"""What all ERAs play: an answer with all its layers, one layer, or drives."""


def playable_layers(drive: Played, rig: Rig) -> tuple[Layer, ...]:
    """Return the layers of a drive, checked against the rig.

    Raises InputError for an answer without layers, an unknown ERA, a frequency outside the rig's
    limits, or drives whose sum at an ERA exceeds full stroke.
    """
    if isinstance(drive, Answer):
        layers = drive.layers
        if not layers:
            raise InputError(
                "an answer must have a layer to be played, got one with quiet fingers only"
            )
    else:
        layers = (drive if isinstance(drive, Layer) else _layer_of(drive, rig),)
    levels = defaultdict[str, float](float)
    for layer in layers:
        for excitation in layer.excitations:
            for name, tone in excitation.items():
                _check_frequency(name, tone.frequency, rig)
                levels[name] += abs(tone.amplitude) / rig.era(name).full_level
    for name, level in levels.items():
        if not level <= _MAX_SUM:  # NaN, too
            raise InputError(
                f"total level of {name} must be at most 1, full level of "
                f"{rig.era(name).full_level:g} {rig.era(name).UNIT}, got {level}"
            )
    return layers


def _check_frequency(name: str, frequency: float, rig: Rig) -> None:
    """Raise InputError for a frequency [Hz] of an ERA outside the rig's limits."""
    limits = rig.limits
    if not limits.frequency_min <= frequency <= limits.frequency_max:
        raise InputError(
            f"frequency of {name} must be from {limits.frequency_min:g} to "
            f"{limits.frequency_max:g} Hz, got {frequency} Hz; widen limits.frequency of "
            "the rig"
        )


def _layer_of(drive: object, rig: Rig) -> Layer:
    """Combine drives into one layer."""
    if not isinstance(drive, Mapping):
        raise InputError(
            "drive must be an answer, a layer or a mapping of names of ERAs, such as "
            f'{{"SW": 110}}, got {shown(drive)}'
        )
    tones: dict[str, list[Tone]] = {}
    for name, driven in drive.items():
        drives = driven if isinstance(driven, list) else [driven]
        tones[name] = [_tone_of(item, name, rig) for item in drives]
    count = max([1, *map(len, tones.values())])
    excitations = []
    for number in range(count):
        with_tone = {name: row for name, row in tones.items() if number < len(row)}
        excitations.append({name: row[number] for name, row in with_tone.items()})
    return Layer(excitations[0], side_bands=tuple(excitations[1:]))


def _tone_of(driven: Driven, name: str, rig: Rig) -> Tone:
    """Convert an ERA's drive to a tone; raises InputError for anything else."""
    stroke = rig.era(name).full_level
    if isinstance(driven, tuple):
        raise InputError(
            f"drive of {name} must be a frequency, a Drive, a Tone or a list of drives, got "
            f"{driven}; make one drive with era.Drive(110, 0.5, 90)"
        )
    if isinstance(driven, Tone):
        for key, unit in _UNITS_OF_A_TONE.items():
            expect_number(getattr(driven, key), what=f"{key} of the tone of {name}", unit=unit)
        return driven
    drive = driven if isinstance(driven, Drive) else Drive(driven)
    level = float(drive.level) * stroke
    return Tone(float(drive.frequency), level, math.radians(drive.phase_deg))
