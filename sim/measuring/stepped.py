"""Stepped tones as a check of a multisine: one ERA and one frequency at a time."""

from dataclasses import dataclass

import numpy as np

from drivers.errors import LinkError
from model.arrays import ComplexArray, FloatArray
from model.calibration.responses import Responses
from sim.measuring.desk import Desk
from sim.measuring.loopback import is_whole
from sim.measuring.measure import Measured, Progress, responses_of_samples
from sim.measuring.multisine import PERIOD
from sim.measuring.sound_card import SoundCard

_SETTLING = PERIOD  # s; whole periods, so that phases count from the first sample
_PERIODS = 2
_TONES = 5
_LOUD = 0.05  # of the largest at a frequency; maxima sit in antiresonances
_RAMP = 0.02  # s


@dataclass(frozen=True)
class Stepped:
    """Multisine beside stepped tones, of responses above 5 % of the largest at their frequency.

    level_db, phase_deg: root mean square and largest difference; frequencies (n,) [Hz].
    """

    frequencies: FloatArray
    level_db: tuple[float, float]
    phase_deg: tuple[float, float]

    def as_json(self) -> dict[str, object]:
        """For programs."""
        return {
            "frequencies_hz": self.frequencies.tolist(),
            "level_rms_db": self.level_db[0],
            "level_max_db": self.level_db[1],
            "phase_rms_deg": self.phase_deg[0],
            "phase_max_deg": self.phase_deg[1],
        }


def check_by_steps(
    desk: Desk,
    card: SoundCard,
    measured: Measured,
    *,
    level: float,
    progress: Progress = lambda done, total: None,
) -> Stepped:
    """Play some of the frequencies on each ERA alone; raises LinkError for lost blocks."""
    known = measured.responses
    rows = np.unique(np.linspace(0, len(known.frequencies) - 1, _TONES).round().astype(int))
    frequencies = known.frequencies[rows]
    values = np.empty((len(rows), desk.input, len(desk.eras) + 1), dtype=complex)
    for era in range(len(desk.eras)):
        for row, frequency in enumerate(frequencies):
            values[row, :, era] = _played(desk, card, era, frequency, level)
            progress(era * len(rows) + row + 1, len(desk.eras) * len(rows))
    found = responses_of_samples(desk, frequencies, values, measured.converters[rows])
    return _compared(frequencies, known.values[rows], found)


def _played(desk: Desk, card: SoundCard, era: int, frequency: float, level: float) -> ComplexArray:
    """Amplitudes (inputs,) by full scale of one ERA; the loop-back shows lost blocks."""
    count = round((_SETTLING + _PERIODS * PERIOD + _RAMP) * card.rate)
    tone = np.cos(2 * np.pi * frequency * np.arange(count) / card.rate)
    ramp = np.sin(np.linspace(0, np.pi / 2, round(_RAMP * card.rate))) ** 2
    tone[: len(ramp)] *= ramp
    sources = np.zeros((count, len(desk.eras) + 1))
    sources[:, era] = sources[:, -1] = level * tone
    heard = card.run(desk.on_outputs(sources)).astype(float)
    start = round(_SETTLING * card.rate)
    period = round(PERIOD * card.rate)
    kept = heard[start : start + _PERIODS * period]
    if card.gaps or not is_whole(kept[:, desk.input - 1], samples=period):
        raise LinkError("blocks of sound were lost between stepped tones; measure again")
    spectrum = np.fft.rfft(kept, axis=0)[round(frequency * PERIOD) * _PERIODS]
    return np.asarray(spectrum * 2 / len(kept) / level)


def _compared(frequencies: FloatArray, one: ComplexArray, other: Responses) -> Stepped:
    size = np.abs(one)
    ratio = (other.values / one)[size > _LOUD * size.max(axis=(1, 2), keepdims=True)]
    level, phase = 20 * np.log10(np.abs(ratio)), np.degrees(np.angle(ratio))
    both = [
        (float(np.sqrt((each**2).mean())), float(np.abs(each).max())) for each in (level, phase)
    ]
    return Stepped(frequencies, both[0], both[1])
