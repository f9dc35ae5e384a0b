"""Stepped tones as a check of a multisine: one ERA and one frequency at a time."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.errors import LinkError
from model.arrays import ComplexArray, FloatArray
from model.calibration.responses import Responses
from sim.measuring.desk import Desk
from sim.measuring.loopback import is_whole
from sim.measuring.measure import Measured
from sim.measuring.multisine import Multisine
from sim.measuring.run import run_time
from sim.measuring.sound_card import SoundCard

_PERIODS = 2
_TONES = 5
_LOUD = 0.05  # of the largest at a frequency; maxima sit in antiresonances


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
    progress: Callable[[int, int], None] = lambda done, total: None,
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
    found = desk.responses(frequencies, values, measured.looped[rows])
    return _compared(frequencies, known.values[rows], found)


def _played(desk: Desk, card: SoundCard, era: int, frequency: float, level: float) -> ComplexArray:
    """Amplitudes (inputs,) by full scale of one ERA; the loop-back shows lost blocks."""
    tone = Multisine(np.array([frequency]), 1, card.rate, level)
    signal = tone.signal(0, periods=run_time(_PERIODS))
    sources = np.zeros((len(signal), len(desk.eras) + 1))
    sources[:, [era, -1]] = signal
    heard = card.run(desk.on_outputs(sources)).astype(float)
    kept = heard[tone.samples : (1 + _PERIODS) * tone.samples]  # once settled
    if card.gaps or not is_whole(kept[:, desk.input - 1], samples=tone.samples):
        raise LinkError("blocks of sound were lost between stepped tones; measure again")
    return np.asarray(tone.found(kept)[0] / tone.played(0)[0])


def _compared(frequencies: FloatArray, one: ComplexArray, other: Responses) -> Stepped:
    size = np.abs(one)
    ratio = (other.values / one)[size > _LOUD * size.max(axis=(1, 2), keepdims=True)]
    level, phase = 20 * np.log10(np.abs(ratio)), np.degrees(np.angle(ratio))
    both = [
        (float(np.sqrt((each**2).mean())), float(np.abs(each).max())) for each in (level, phase)
    ]
    return Stepped(frequencies, both[0], both[1])
