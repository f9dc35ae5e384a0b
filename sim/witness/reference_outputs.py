"""Reference model of an amplifier's channels: the levels and frequencies they must have."""

import math
from collections.abc import Mapping, Sequence

from sim.witness.config import AmplifierConfig
from sim.witness.decoded import ChannelCommand, EnvelopeLoad, Request
from sim.witness.fade import Fade
from sim.witness.violation import ReportViolation

LEVEL = 0.002
"""Tolerance of levels, in full strokes: rounding, and the last step of a fade."""

_FINE = 0.011  # Hz; one step of the wire
_MAX_ENVELOPE_TIME = 3.3  # s; the longest envelope


class ReferenceOutputs:
    """The channels of an amplifier; times [s] are intervals, as in `Fade`.

    cause: of the present output, for messages; is_warm: it may derate.
    """

    def __init__(
        self, name: str, config: AmplifierConfig, *, slack: float, report: ReportViolation
    ) -> None:
        self._name = name
        self._config = config
        self._slack = slack
        self._report = report
        self.cause = "nothing"
        self.is_warm = False
        self._fades: dict[int, Fade] = {}
        self._channel_commands: Mapping[int, ChannelCommand] = {}
        self._levels_before: Mapping[int, float] = {}
        self._endings: dict[int, int] = {}
        self._durations: dict[int, float] = {}  # of envelopes, by slot
        self._ends: tuple[float, float] | None = None
        self._ramp = 0.0
        # Levels that sensors measured too low, which an unreported fault would explain.
        self._suspicions: list[tuple[str, float, str]] = []

    def advance(self, time: float) -> None:
        """End a set whose valid_for has passed."""
        if self._ends is not None and time > self._ends[1] + self._slack:
            self._fades = {channel: self._fade_by(channel, time) for channel in self._channels}
            self._set_silent("the end of valid_for")

    def settle(self, cause: str) -> None:
        """Treat all channels as silent, their fades over."""
        self._fades, self._channel_commands, self.cause = {}, {}, cause
        self._ends = None

    def load(self, envelope: EnvelopeLoad) -> None:
        """Note the duration of a loaded envelope."""
        self._durations[envelope.slot] = envelope.step * (len(envelope.levels) + 1)

    def resolve_suspicions(self, *, is_enabled: bool) -> None:
        """Report suspicions, unless a fault explains them."""
        if is_enabled:
            for suspicion in self._suspicions:
                self._report(*suspicion)
        self._suspicions.clear()

    def play(
        self, request: Request, commands: Mapping[int, ChannelCommand], begin: float, end: float
    ) -> None:
        """Play a set, started between two times [s]."""
        self._levels_before = {channel: fade.after for channel, fade in self._fades.items()}
        for channel in self._channels | set(commands):
            command = commands.get(channel)
            level = command.level if command is not None else 0.0
            fade = self._fade_by(channel, end).to(level, begin=(begin, end), ramp=request.ramp)
            shaped = self._shaping(channel, command)
            self._fades[channel] = fade._replace(unknown_until=end + shaped) if shaped else fade
        self._channel_commands, self.cause, self._ramp = commands, "set", request.ramp
        self._endings = {
            channel: command.ending for channel, command in commands.items() if command.ending
        }
        ends = request.valid_for > 0
        self._ends = (begin + request.valid_for, end + request.valid_for) if ends else None

    def silence(self, begin: tuple[float, float], ramp: float, cause: str) -> None:
        """Silence all channels along a ramp [s]."""
        for channel in self._channels:
            fade = self._fade_by(channel, begin[1])
            if fade.after > 0 or fade.settled_from > begin[0] + ramp:  # it may not come later
                self._fades[channel] = fade.to(0.0, begin=begin, ramp=ramp)
        self._set_silent(cause)

    def forget(self) -> None:
        """Treat the output as unknown, its end included."""
        self._ends = None
        self.set_unknown(math.inf)

    def set_unknown(self, until: float) -> None:
        """Treat the output as unknown until a time [s]."""
        for channel in self._channels:
            fade = self._fades.get(channel, Fade())
            self._fades[channel] = fade._replace(unknown_until=until, before=(0.0, 1.0))

    def check_sensors(
        self,
        levels: Sequence[float],
        frequencies: Mapping[int, float],
        time: float,
        *,
        may_be_off: bool,
        is_enabled: bool,
    ) -> None:
        """Compare measured levels, and known frequencies [Hz]."""
        self.check_levels(levels, time, time, may_be_off=may_be_off, of_sensor=is_enabled)
        for channel, frequency in frequencies.items():
            command = self._channel_commands.get(channel)
            is_settled = time > self._fades.get(channel, Fade()).settled_from
            is_commanded = command is not None and command.level > 0 and is_settled
            if command is not None and is_commanded and abs(frequency - command.frequency) > _FINE:
                self._report(
                    "plays",
                    time,
                    f"channel {channel} of {self._name} vibrates at {frequency:g} Hz, commanded "
                    f"{command.frequency:g} Hz",
                )

    def check_levels(
        self,
        levels: Sequence[float],
        begin: float,
        end: float,
        *,
        may_be_off: bool,
        of_sensor: bool = False,
    ) -> None:
        """Report levels that are impossible at every time between two [s].

        may_be_off: whether the watchdog may have expired.
        """
        for channel, level in enumerate(levels):
            fade = self._fade_by(channel, end + self._slack)
            low, high = fade.within(begin - self._slack, end + self._slack)
            is_low = False
            if level > high + LEVEL:
                wrong = f"at most {high:.4f}"
            elif level < low - LEVEL and not (self.is_warm or may_be_off):
                is_low = True
                wrong = f"at least {low:.4f}"
            else:
                continue
            is_settled = begin > fade.settled_from
            found = (
                self._rule_of_level(channel, level, is_settled=is_settled),
                end,
                f"channel {channel} of {self._name}: level must be {wrong}, got {level:.4f} "
                f"{'' if is_settled else 'fading '}after {self.cause}",
            )
            if is_low and of_sensor:
                self._suspicions.append(found)
            else:
                self._report(*found)

    @property
    def _channels(self) -> set[int]:
        return {*self._config.channels, *self._fades}

    def _fade_by(self, channel: int, time: float) -> Fade:
        """The fade of a channel at a time [s], by which its set may have ended."""
        fade = self._fades.get(channel, Fade())
        if self._ends is None or time < self._ends[0]:
            return fade
        fade = fade.to(0.0, begin=self._ends, ramp=self._ramp)
        free = max((self._duration(slot) for slot in self._endings.values()), default=0.0)
        return fade._replace(unknown_until=self._ends[1] + free) if free else fade

    def _set_silent(self, cause: str) -> None:
        self._channel_commands, self.cause = {}, cause
        self._ends = None
        self._endings = {}

    def _rule_of_level(self, channel: int, level: float, *, is_settled: bool) -> str:
        if self.cause == "the watchdog":
            return "watchdog"
        if not is_settled:
            return "ramp"
        if self.cause != "set":
            return "silent"
        before = self._levels_before.get(channel, 0.0)
        return "commit" if abs(level - before) < LEVEL else "plays"

    def _shaping(self, channel: int, command: ChannelCommand | None) -> float:
        """Duration of the envelope that a channel follows [s]; 0 for none."""
        if command is not None and command.onset:
            return self._duration(command.onset)
        is_silent = command is None or command.level == 0
        skips = command is not None and command.skip_ending
        if is_silent and not skips and channel in self._endings:
            return self._duration(self._endings[channel])
        return 0.0

    def _duration(self, slot: int) -> float:
        return self._durations.get(slot, _MAX_ENVELOPE_TIME)
