"""The witness: bytes of every wire in, violations out. No clock, no I/O."""

import math
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from typing import Any, Literal

from sim.witness.amplifier_session import AmplifierSession
from sim.witness.capture import Direction
from sim.witness.config import WitnessConfig, parse_config
from sim.witness.decoded import CHANGING, Damaged
from sim.witness.delays import Delays
from sim.witness.exchanges import Exchanges
from sim.witness.expected_amplifier import ExpectedAmplifier
from sim.witness.host_rules import HostRules
from sim.witness.set_rules import ExpectedSets
from sim.witness.violation import Report, Violation
from sim.witness.watched_wire import WatchedWire

OperatorCommand = Literal["arm", "disarm", "stop", "clear"]


class Witness:
    """Checks the wires of a configuration (see `sim.witness.config`); times [s] of any one clock.

    Bytes are sufficient; contacts, operator commands, stalls and sensor levels enable further
    rules. record: called with each piece of bytes as a line of a capture.
    """

    def __init__(
        self,
        config: Mapping[str, Any] | WitnessConfig,
        *,
        record: Callable[[str], None] | None = None,
    ) -> None:
        self._config = config if isinstance(config, WitnessConfig) else parse_config(config)
        self._report = Report()
        self._record = record
        self._now = -math.inf
        self.frames = 0
        self._sessions: dict[str, AmplifierSession] = {}
        self._wires: dict[str, WatchedWire] = {}
        for wire, kind in self._config.wires.items():
            sessions = {}
            for name, one in self._config.amplifiers.items():
                if one.wire == wire:
                    sessions[one.address] = self._sessions[name] = self._session(name)
            self._wires[wire] = WatchedWire(wire, kind, sessions)
        times = self._config.times_s
        self._delays = Delays()
        self._host = HostRules(self._sessions, times=times, delays=self._delays)
        self._exchanges = Exchanges(
            self._host, times=times, delays=self._delays, report=self._report
        )

    def _session(self, name: str) -> AmplifierSession:
        config = self._config.amplifiers[name]

        def report(invariant: str, time: float, sentence: str) -> None:
            self._report.add(invariant, config.wire, time, sentence)

        def is_disturbed(time: float) -> bool:
            return self._wires[config.wire].is_disturbed(time)

        def report_unless_disturbed(invariant: str, time: float, sentence: str) -> None:
            if not is_disturbed(self._now):
                report(invariant, time, sentence)

        amplifier = ExpectedAmplifier(
            name,
            times=self._config.times_s,
            report=report_unless_disturbed,
            report_always=report,
        )
        return AmplifierSession(name, config, amplifier, report, is_disturbed)

    @property
    def wires(self) -> tuple[str, ...]:
        """The names of the wires."""
        return tuple(self._wires)

    def record_bytes(self, link: str, direction: Direction, time: float, data: bytes) -> None:
        """Process bytes on a wire, toward the amplifier or the host."""
        self._advance(time)
        wire = self._wires[link]
        if self._record is not None:
            arrow = ">" if direction == "amplifier" else "<"
            self._record(f"{time:.6f} {link} {arrow} {data.hex()}")
        for begun, (raw, message) in wire.feed(direction, time, data):
            self.frames += 1
            self._report.frame(link, time, direction, raw)
            if message is None:
                continue
            if isinstance(message, Damaged):
                self._exchanges.damaged(wire, time, direction, message, begun)
            if direction == "amplifier":
                self._exchanges.sent(wire, time, raw, message, begun)
            else:
                self._exchanges.received(wire, time, message)

    def delayed(self, until: float, duration: float) -> None:
        """Note that this program did not run for a duration [s] until a time [s].

        Deadlines of hosts and amplifiers are extended by it: what came in time was seen late.
        """
        self._delays.note(until, duration)

    def opened(self, link: str, time: float) -> None:
        """Note that a host has opened a wire: its amplifiers are not identified yet."""
        self._advance(time)
        wire = self._wires[link]
        wire.reset()
        wire.forget_pending()
        for session in wire.sessions.values():
            session.is_open, session.is_identified, session.session = True, False, None
            session.layers.clear()
            session.constants.clear()  # it may be another one
            session.amplifier.forget_state()

    def closed(self, link: str, time: float) -> None:
        """Note that the host has closed or lost a wire."""
        self._advance(time)
        wire = self._wires[link]
        if wire.pending:
            wire.disturb(time)  # the next host may receive their replies
        for pending in wire.pending.values():
            if pending.sent.request.name in CHANGING:
                pending.session.amplifier.forget_state()  # it may execute a request unheard
        wire.forget_pending()
        for session in wire.sessions.values():
            session.is_open = False
            session.stop_requested_at = session.last_feed = session.first_stop = None

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
        self._host.expect(expected)

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
        if not are_on:  # what amplifiers did meanwhile may be unseen
            for session in self._wires[link].sessions.values():
                session.amplifier.forget_state()

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
                session.report(
                    "limits", time, f"channel {channel} of {amplifier} has level {level:.4f}"
                )
        wire = self._wires[session.config.wire]
        # A reply that is on its way is of an earlier time, which must not be passed before.
        is_pending = any(pending.session is session for pending in wire.pending.values())
        if not (is_pending or session.is_disturbed(time)):
            session.amplifier.check_sensors(levels, frequencies or {}, time)

    def finish(self, time: float | None = None) -> list[Violation]:
        """The violations in order; time [s]: end of the observation."""
        if time is not None:
            self._advance(time)
        return self._report.found

    def _advance(self, time: float) -> None:
        self._now = max(self._now, time)
        self._host.advance(self._now)
        for wire in self._wires.values():
            for session in wire.sessions.values():
                session.amplifier.advance(self._now)
            self._exchanges.check_overdue(wire, self._now)
