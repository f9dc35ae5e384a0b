"""The witness: bytes of every wire in, violations out. No clock, no I/O."""

import math
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from typing import Any, Literal

from drivers.judge.watching.amplifier_session import AmplifierSession, Delays, ExpectedSets
from drivers.judge.watching.capture import Direction, Report, Violation, capture_line
from drivers.judge.watching.config import WitnessConfig, parse_config
from drivers.judge.watching.host_rules import HostRules
from drivers.judge.watching.watched_amplifier import WatchedAmplifier
from drivers.judge.watching.watched_wire import WatchedWire

OperatorCommand = Literal["arm", "disarm", "stop", "clear"]


class Witness:
    """Checks the wires of a configuration (see `drivers.judge.watching.config`); times [s] of any one clock.

    Bytes are sufficient; contacts, operator commands, stalls and sensor levels enable further
    rules. record: called with each piece of bytes as a line of a capture.
    """

    def __init__(
        self,
        config: Mapping[str, Any] | WitnessConfig,
        *,
        record: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._config = config if isinstance(config, WitnessConfig) else parse_config(config)
        self._report = Report()
        self._record = record
        self._now = -math.inf
        self.frames = 0
        self._delays = Delays()
        self._sessions = {name: self._session(name) for name in self._config.amplifiers}
        times = self._config.times_s
        self._host = HostRules(self._sessions, times=times, delays=self._delays)
        self._wires = {
            wire: WatchedWire(
                wire,
                kind,
                {
                    one.config.address: one
                    for one in self._sessions.values()
                    if one.config.wire == wire
                },
                host=self._host,
                times=times,
                delays=self._delays,
                report=self._report,
            )
            for wire, kind in self._config.wires.items()
        }

    def _session(self, name: str) -> AmplifierSession:
        config = self._config.amplifiers[name]

        def report_always(invariant: str, time: float, sentence: str) -> None:
            self._report.add(invariant, config.wire, time, sentence)

        def is_disturbed(time: float) -> bool:
            return self._wires[config.wire].is_disturbed(time)

        def report(invariant: str, time: float, sentence: str) -> None:
            if not is_disturbed(time):
                report_always(invariant, time, sentence)

        slack = self._config.times_s.slack
        amplifier = WatchedAmplifier(name, slack=slack, report=report, report_always=report_always)
        return AmplifierSession(name, config, amplifier, report_always, report, is_disturbed)

    @property
    def wires(self) -> tuple[str, ...]:
        """The names of the wires."""
        return tuple(self._wires)

    def record_bytes(self, link: str, direction: Direction, time: float, data: bytes) -> None:
        """Process bytes on a wire, toward the amplifier or the host."""
        self._advance(time)
        self._record(capture_line(time, link, direction, data))
        self.frames += self._wires[link].feed(direction, time, data)

    def delayed(self, until: float, duration: float) -> None:
        """Note that this program did not run for a duration [s] until a time [s].

        Deadlines of hosts and amplifiers are extended by it: what came in time was seen late.
        """
        self._delays.note(until, duration)

    def opened(self, link: str, time: float) -> None:
        """Note that a host has opened a wire: its amplifiers are not identified yet."""
        self._advance(time)
        self._wires[link].opened(time)

    def closed(self, link: str, time: float) -> None:
        """Note that the host has closed or lost a wire."""
        self._advance(time)
        self._wires[link].closed(time)

    def contacts(
        self, time: float, contacts: Collection[Hashable], *, is_answerable: bool = True
    ) -> None:
        """Replace the contacts on the plate, by any id.

        is_answerable: whether new ones must lead to a pattern.
        """
        self._advance(time)
        self._host.contacts(time, contacts, is_answerable=is_answerable)

    def expect(self, expected: ExpectedSets | None) -> None:
        """Set what every pattern must be, by amplifier and channel; None for any."""
        self._host.expected = expected

    def operator_command(self, time: float, command: OperatorCommand) -> None:
        """Note an operator's command to the controller."""
        self._advance(time)
        self._host.operator_command(time, command)

    def set_stalled(self, time: float, is_stalled: bool = True) -> None:
        """Note that the control loop stalls, or runs again."""
        self._advance(time)
        self._host.set_stalled(time if is_stalled else None)

    def faults(self, time: float, link: str, *, are_on: bool) -> None:
        """Note the start or the end of injected faults on a wire or its amplifiers."""
        self._advance(time)
        self._wires[link].set_disturbed(time, is_on=are_on)

    def levels(
        self,
        time: float,
        amplifier: str,
        levels: Sequence[float],
        *,
        frequencies: Mapping[int, float] | None = None,
    ) -> None:
        """Compare measured levels (1 is full stroke) and frequencies [Hz] of an amplifier."""
        self._advance(time)
        session = self._sessions[amplifier]
        for channel, level in enumerate(levels):
            limits = session.config.channels.get(channel)
            if level > (limits.level if limits is not None else 0.0) + 0.002:
                session.report_always(
                    "limits", time, f"channel {channel} of {amplifier} has level {level:.4f}"
                )
        # A reply that is on its way is of an earlier time, which must not be passed before.
        is_pending = self._wires[session.config.wire].is_pending(session)
        if not (is_pending or session.is_disturbed(time)):
            session.amplifier.check_sensors(levels, frequencies or {}, time)

    def finish(self, time: float | None = None) -> list[Violation]:
        """The violations in order; time [s]: end of the observation."""
        if time is not None:
            self._advance(time)
        return list(self._report.found)

    def _advance(self, time: float) -> None:
        self._now = max(self._now, time)
        self._host.advance(self._now)
        for session in self._sessions.values():
            session.amplifier.advance(self._now)
        for wire in self._wires.values():
            wire.advance(self._now)
