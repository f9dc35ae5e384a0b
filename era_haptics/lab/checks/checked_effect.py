"""Result of the check of one effect in one region of a surface layout."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from era_haptics.lab.checks.touch_simulator import SimulatedTouch


@dataclass(frozen=True)
class CheckedEffect:
    """Simulated touches of an effect in a region.

    on: layout key that plays the effect; promised_db_sl: None for as strong as the neighbors
    allow; touches: at each position alone, then with a resting finger; area [m²]: share of the
    region for each position.
    """

    region: str
    effect: str
    on: str
    promised_db_sl: float | None
    touches: tuple[SimulatedTouch, ...]
    problems: tuple[str, ...]

    @property
    def felt(self) -> list[float]:
        """Levels [dB SL] of all touches that are felt, over the effect."""
        levels = [touch.felt_db_sl for touch in self.touches]
        return [level for level in levels if level is not None]

    @property
    def contrasts(self) -> list[float]:
        """Contrast with the resting finger on the nominal plate [dB]."""
        contrasts = []
        for touch in self.touches:
            if touch.felt_db_sl is not None and touch.resting_db_sl is not None:
                contrasts.append(touch.felt_db_sl - touch.resting_db_sl)
        return contrasts

    @property
    def promised_contrasts(self) -> list[float]:
        """Contrast with the resting finger on 90 % of plates [dB]."""
        contrasts = [touch.promised_contrast_db for touch in self.touches]
        return [contrast for contrast in contrasts if contrast is not None]

    @property
    def held_back_db(self) -> float:
        """Largest reduction of a touch [dB] for the resting finger's sake."""
        return max((touch.held_back_db for touch in self.touches), default=0.0)

    @property
    def exposure_m_s2(self) -> float:
        """Highest weighted RMS acceleration of a touch [m/s²] (`exposures`)."""
        return max((touch.exposure_m_s2 for touch in self.touches), default=0.0)

    @property
    def frequencies(self) -> list[float]:
        """All frequencies played [Hz], ascending."""
        return frequencies_of(self.touches)

    def as_json(self) -> dict[str, Any]:
        """Return the JSON object of `era layout check --json`."""
        return {
            "region": self.region,
            "effect": self.effect,
            "on": self.on,
            "promised_db_sl": self.promised_db_sl,
            "felt_db_sl": distribution(self.felt),
            "promised_contrast_db": distribution(self.promised_contrasts),
            "felt_contrast_db": distribution(self.contrasts),
            "held_back_db": self.held_back_db,
            "exposure_m_s2": self.exposure_m_s2,
            "frequency_hz": self.frequencies,
            "touches": len(self.touches),
            "problems": [*self.problems],
        }


def distribution(values: Sequence[float]) -> dict[str, float | None]:
    """Return minimum, median and maximum; None without values."""
    if not values:
        return {"min": None, "median": None, "max": None}
    return {
        "min": float(min(values)),
        "median": float(np.median(values)),
        "max": float(max(values)),
    }


def frequencies_of(touches: Sequence[SimulatedTouch]) -> list[float]:
    """Return all frequencies played [Hz], ascending."""
    frequencies: set[float] = set()
    for touch in touches:
        frequencies.update(touch.frequencies)
    return sorted(frequencies)
