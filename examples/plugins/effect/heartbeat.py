"""A heartbeat: two pulses, the second one weaker, repeated while the finger rests."""

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
SECOND = 0.25  # s; from the first pulse of a beat to its second
WEAKER = 6.0  # dB
_ROUNDING = 1e-6  # s; at the end of a pulse the next part counts


class Beating(EffectRun):
    """A heartbeat at one finger."""

    def __init__(self, start: float, period: float, level_db_sl: float | None) -> None:
        self.start, self.period, self.level_db_sl = start, period, level_db_sl
        self.pulse = Pulse(PULSE, start)  # the last one

    def feel(self, contact: Contact, now: float) -> EffectStimulus | NoStimulus:
        """Return the current pulse or pause, and when it ends."""
        beats, into = divmod(now - self.start + _ROUNDING, self.period)
        beat = self.start + beats * self.period
        is_second = into >= SECOND
        latest = beat + SECOND if is_second else beat
        if self.pulse.requested_at != latest:
            self.pulse = Pulse(PULSE, latest)
        if now + _ROUNDING >= self.pulse.end:
            return NoStimulus(until=beat + (self.period if is_second else SECOND))
        if not is_second:
            return EffectStimulus(self.level_db_sl, until=self.pulse.end, pulse=self.pulse)
        weaker = None if self.level_db_sl is None else self.level_db_sl - WEAKER
        return EffectStimulus(weaker, until=self.pulse.end, pulse=self.pulse)


class Heartbeat(Effect):
    """The effect; its fields are its parameters in a layout, in addition to `level`."""

    kind: ClassVar[str] = "example-heartbeat"
    is_for_motion: ClassVar[bool] = False  # for on_press

    period: Annotated[float, Quantity(TIME, at_least=0.4, at_most=5.0)] = 0.9

    def start(self, contact: Contact, now: float, *, level_db_sl: float | None) -> EffectRun:
        """Start at a finger."""
        return Beating(now, self.period, level_db_sl)

    @property
    def has_end(self) -> bool:
        """Whether a run ends by itself."""
        return False
