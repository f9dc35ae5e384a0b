"""The frequency of a vibration, which a layout may fix."""

from typing import Annotated, Self, TypeAlias

from pydantic import Strict, model_validator

from controller.play.intent import band_of_table
from model.arrays import FloatArray
from model.config.sections import Quantity, Section
from model.config.units import FREQUENCY

Band: TypeAlias = tuple[float, float]
"""Lowest and highest frequency [Hz]; equal ones stand for the nearest that a table has."""

_TOLERANCE = 0.05  # of a frequency; less than anyone tells apart


def band_problem(band: Band, frequencies: FloatArray) -> str | None:
    """Return what a table with these frequencies [Hz] plays instead of a band that it lacks."""
    low, high = band
    nearest = band_of_table(band, frequencies)[0]
    if low * (1 - _TOLERANCE) <= nearest <= high * (1 + _TOLERANCE):
        return None
    given = f"{low:g} Hz" if low == high else f"{low:g} to {high:g} Hz"
    return f"frequency {given} is not in the table, which plays {nearest:g} Hz instead"


_FREQUENCY = Annotated[float, Quantity(FREQUENCY, at_least=10, at_most=1000)]


class TunedSection(Section):
    """A section that may fix the frequency, or the band that it is in."""

    frequency: _FREQUENCY | None = None
    band: Annotated[tuple[_FREQUENCY, _FREQUENCY], Strict(strict=False)] | None = None

    @model_validator(mode="after")
    def _check_band(self) -> Self:
        if self.band is None:
            return self
        if self.frequency is not None:
            raise ValueError("must have frequency or band, got both; remove one")
        if self.band[0] >= self.band[1]:
            low, high = self.band
            raise ValueError(
                f"band must be a lower and a higher frequency, got {low:g} Hz and {high:g} Hz"
            )
        return self

    @property
    def tuned_band(self) -> Band | None:
        """The band of its frequency; None where it is free."""
        return self.band if self.frequency is None else (self.frequency, self.frequency)
