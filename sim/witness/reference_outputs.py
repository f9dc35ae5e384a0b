"""What the channels of one amplifier must play, and whether they do."""

import math
from collections.abc import Mapping, Sequence

from sim.witness.config import AmplifierConfig
from sim.witness.decoded import ChannelCommand, EnvelopeLoad, ReportViolation, Request
from sim.witness.fade import Fade

LEVEL = 0.002
"""Of full stroke: what rounding and the last bit of a fade may make."""

_FINE = 0.011  # Hz; one step of the wire
_LONGEST = 3.3  # s; that an envelope can take


class ReferenceOutputs:
    """The channels of an amplifier by its name; times [s] within bounds, as of `Fade`.

    cause: what they do what they do for; is_warm: it may play less than it was told.
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
        # Of sensors that find too little, while it may be in a fault of its own that nobody knows.
        self._suspicions: list[tuple[str, float, str]] = []

    def advance(self, time: float) -> None:
        """Let a set end whose time is over."""
        if self._ends is not None and time > self._ends[1] + self._slack:
            self._fades = {channel: self._fade_by(channel, time) for channel in self._channels}
            self._is_silent_after("the end of valid_for")

    def rest(self, cause: str) -> None:
        """They have been silent for as long as matters."""
        self._fades, self._channel_commands, self.cause = {}, {}, cause
        self._ends = None

    def load(self, envelope: EnvelopeLoad) -> None:
        """An envelope is in its slot."""
        self._durations[envelope.slot] = envelope.step * (len(envelope.levels) + 1)

    def resolve_suspicions(self, *, is_enabled: bool) -> None:
        """It says how it is: what sensors found before is wrong, unless it is in a fault."""
        if is_enabled:
            for suspicion in self._suspicions:
                self._report(*suspicion)
        self._suspicions.clear()

    def play(
        self, request: Request, commands: Mapping[int, ChannelCommand], begin: float, end: float
    ) -> None:
        """A set is played, taken over within two times [s]."""
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
        """All fall silent along a ramp [s]."""
        for channel in self._channels:
            fade = self._fade_by(channel, begin[1])
            self._fades[channel] = fade.to(0.0, begin=begin, ramp=ramp)
        self._is_silent_after(cause)

    def forget(self) -> None:
        """Nobody knows what they play, nor whether it ends by itself."""
        self._ends = None
        self.free(math.inf)

    def free(self, until: float) -> None:
        """Nobody knows what they play until a time [s]."""
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
        """What a sensor finds on its channels: levels, and where it is known the frequency [Hz]."""
        self.check_levels(levels, time, time, may_be_off=may_be_off, of_sensor=is_enabled)
        for channel, frequency in frequencies.items():
            command = self._channel_commands.get(channel)
            is_settled = time > self._fades.get(channel, Fade()).settled_from
            is_told = command is not None and command.level > 0 and is_settled
            if command is not None and is_told and abs(frequency - command.frequency) > _FINE:
                self._report(
                    "plays",
                    time,
                    f"channel {channel} of {self._name} vibrates at {frequency:g} Hz; it was told "
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
        """Complain of levels that they cannot have at some time between two [s].

        may_be_off: whether its watchdog may have run out by now.
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
                f"channel {channel} of {self._name} has level {level:.4f}; it must be {wrong}, "
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
        """What a channel does up to a time [s], by which its set may have ended."""
        fade = self._fades.get(channel, Fade())
        if self._ends is None or time < self._ends[0]:
            return fade
        fade = fade.to(0.0, begin=self._ends, ramp=self._ramp)
        free = max((self._duration(slot) for slot in self._endings.values()), default=0.0)
        return fade._replace(unknown_until=self._ends[1] + free) if free else fade

    def _is_silent_after(self, cause: str) -> None:
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
        """How long an envelope shapes what a channel does now [s]; 0 for none."""
        if command is not None and command.onset:
            return self._duration(command.onset)
        is_silent = command is None or command.level == 0
        skips = command is not None and command.skip_ending
        if is_silent and not skips and channel in self._endings:
            return self._duration(self._endings[channel])
        return 0.0

    def _duration(self, slot: int) -> float:
        return self._durations.get(slot, _LONGEST)
