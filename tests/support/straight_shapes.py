"""Envelopes that are straight lines."""

import cmath
from collections.abc import Iterable, Sequence
from dataclasses import replace

from model.table.pattern import Pattern
from model.table.question import Question
from model.transients.base_motion import BaseEnvelope


class Shapes:
    """A timing whose envelopes are straight lines: up in 21 knots, down in 8."""

    levels = None

    def __init__(self) -> None:
        self.prepared: list[float] = []
        self.largest = 1.0

    def prepare(self, frequencies: Iterable[float]) -> None:
        """Remember them."""
        self.prepared += frequencies

    def with_envelopes(
        self, question: Question, pattern: Pattern, *, onset: bool, ending: bool
    ) -> Pattern:
        """The lines, for the ERAs that play; the largest knot of an onset can be set."""
        up = [number / 21 * self.largest for number in range(1, 21)] + [1.0]
        down = [1 - number / 8 for number in range(1, 9)]
        return replace(
            pattern,
            onset=_along(pattern, 0.0, up) if onset else pattern.onset,
            ending=_along(pattern, 1.0, down) if ending else pattern.ending,
        )

    def with_transient_measures(self, question: Question, pattern: Pattern) -> Pattern:
        """30 dB with an onset, 10 without."""
        return replace(pattern, transient_contrast_db=30.0 if pattern.onset else 10.0)


def _along(pattern: Pattern, start: float, shares: Sequence[float]) -> dict[str, BaseEnvelope]:
    tones = {
        name: (tone.frequency, cmath.rect(tone.amplitude, tone.phase))
        for name, tone in pattern.excitation.items()
    }
    return {
        name: BaseEnvelope(frequency, start * full, tuple(share * full for share in shares))
        for name, (frequency, full) in tones.items()
    }
