"""An impedance through a sound card: voltage before a resistor, and over it, of one multisine.

    output ──┬── exciter ──┬── resistor R ── ground
            V_1           V_2                         Z = R (V_1 / V_2 - 1)

Delay, filters and gain of the two inputs are taken as the same; one input that is moved from the
first place to the second has them the same, whatever they are.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.files.csv_file import read_lines, write_columns
from sim.desk.measuring.impedance import HIGH, LOW
from sim.desk.measuring.loopback import check_levels
from sim.desk.measuring.multisine import Multisine
from sim.desk.measuring.runs import play_on_one
from sim.desk.measuring.sound_card import SoundCard

_PLACES = ("before the exciter", "over the resistor")
_COLUMNS = ("frequency_hz", "real_ohm", "imag_ohm")
_READ = ("frequency_hz", "real", "imag", "magnitude", "phase_deg")
_UNNAMED = ("frequency_hz", "magnitude", "phase_deg")


LINES: FloatArray = np.unique(np.geomspace(LOW, HIGH, 120).round())
"""Whole frequencies [Hz] from 10 to 1000, nearly at equal ratios."""


def measured_impedance(
    card: SoundCard,
    *,
    inputs: tuple[int, ...],
    series: float,
    level: float,
    periods: int,
    move: Callable[[str], None],
) -> tuple[FloatArray, ComplexArray]:
    """Frequencies (f,) [Hz] and impedance (f,) [ohm] of what is in series with a resistor [ohm].

    inputs: before and over the resistor, counted from 1, or one that is moved: move is then called
    with where to, before each run. Raises InputError, LinkError.
    """
    sines = Multisine(LINES, 1, card.rate, level)
    voltages = list[ComplexArray]()
    for at, place in zip((inputs[0], inputs[-1]), _PLACES, strict=True):
        if len(inputs) == 1:
            move(place)
        if len(inputs) == 1 or not voltages:
            recorded = play_on_one(card, sines, 1, outputs=1, periods=periods)
        check_levels(recorded, {at: f"what is {place}"})
        voltages.append(sines.found(recorded[:, at - 1]))
    return sines.frequencies, np.asarray(series * (voltages[0] / voltages[1] - 1))


def write_impedance(path: Path, frequencies: FloatArray, impedance: ComplexArray) -> None:
    """Write a file of frequencies [Hz] and an impedance [ohm], atomically; raises OSError."""
    columns = (frequencies, impedance.real, impedance.imag)
    write_columns(path, dict(zip(_COLUMNS, columns, strict=True)))


def read_impedance(path: Path) -> tuple[FloatArray, ComplexArray]:
    """Frequencies (f,) [Hz] and impedance (f,) [ohm] of a file, or of one of another program.

    That may have magnitude and phase (ZMA, LIMP, REW) or real and imaginary part, in other words
    and units (`model.files.csv_file.read_lines`). Raises InputError.
    """
    lines = read_lines(path, _READ[:1], optional=_READ[1:], unnamed=_UNNAMED)
    frequencies = np.array([line.number("frequency_hz") for line in lines])
    if frequencies.min() <= 0:
        raise InputError(f"{path}: frequency_hz must be above 0, got {frequencies.min():g}")
    return frequencies, np.array([line.complex_number() for line in lines])
