"""Heartbeat effect: a pulse and a weaker one, repeated while the finger rests."""

from typing import Annotated, ClassVar

from era_haptics.plugins.effects import (
    TIME,
    Contact,
    Effect,
    EffectRun,
    EffectStimulus,
    NoStimulus,
    Pulse,
    Quantity,
)

PULSE = 0.08  # s; the plate needs 20 ms to follow
SECOND_PULSE = 0.25  # s; after the first one
ATTENUATION = 6.0  # dB; of the second pulse
_ROUNDING = 1e-6  # s; a pulse that ends within this time has ended


class Beating(EffectRun):
    """A heartbeat that runs at one finger."""

    def __init__(self, start: float, period: float, level_db_sl: float | None) -> None:
        self.start = start
        self.period = period
        self.level_db_sl = level_db_sl
        self.pulse = Pulse(PULSE, start)  # the latest pulse

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus:
        """Return the pulse or pause at a time [s], with its end."""
        beat_count, elapsed = divmod(now - self.start + _ROUNDING, self.period)
        beat_start = self.start + beat_count * self.period
        if elapsed < SECOND_PULSE:
            pulse_start = beat_start
            next_start = beat_start + SECOND_PULSE
            level = self.level_db_sl
        else:
            pulse_start = beat_start + SECOND_PULSE
            next_start = beat_start + self.period
            level = None if self.level_db_sl is None else self.level_db_sl - ATTENUATION
        if self.pulse.requested_at != pulse_start:
            self.pulse = Pulse(PULSE, pulse_start)
        if now + _ROUNDING >= self.pulse.end:
            return NoStimulus(until=next_start)
        return EffectStimulus(level, until=self.pulse.end, pulse=self.pulse)


class Heartbeat(Effect):
    """The effect. Its fields, and `level`, are its parameters in a layout."""

    kind: ClassVar[str] = "example-heartbeat"
    is_for_motion: ClassVar[bool] = False  # for on_press

    period: Annotated[float, Quantity(TIME, at_least=0.4, at_most=5.0)] = 0.9

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start the effect at a finger."""
        return Beating(now, self.period, level_db_sl)

    @property
    def has_end(self) -> bool:
        """Whether a run ends on its own."""
        return False
