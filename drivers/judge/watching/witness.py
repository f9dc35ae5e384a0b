"""The witness: bytes of every wire in, violations out. No clock, no I/O."""

import math
from collections.abc import Callable
from functools import partial

from drivers.judge.watching.amplifier_session import AmplifierSession, Deadlines
from drivers.judge.watching.capture import Direction, Report, Violation, capture_line
from drivers.judge.watching.config import WitnessConfig
from drivers.judge.watching.host_rules import HostRules
from drivers.judge.watching.watched_amplifier import WatchedAmplifier
from drivers.judge.watching.watched_wire import WatchedWire


class Witness:
    """Checks the wires of a configuration (`drivers.judge.watching.config`); times in s.

    record: called with each piece of bytes as a line of a capture; rules: for hosts.
    """

    def __init__(
        self,
        config: WitnessConfig,
        *,
        record: Callable[[str], None] = lambda line: None,
        rules: type[HostRules] = HostRules,
    ) -> None:
        self._config = config
        self._report = Report()
        self._record = record
        self._now = -math.inf
        self.frames = 0
        self._sessions = {name: self._session(name) for name in self._config.amplifiers}
        times = self._config.times
        self._deadlines = Deadlines()
        self._host = rules(self._sessions, times=times, deadlines=self._deadlines)
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
                deadlines=self._deadlines,
                report=self._report,
            )
            for wire, kind in self._config.wires.items()
        }
        self.wires = tuple(self._wires)
        """The names of the wires."""

    def _session(self, name: str) -> AmplifierSession:
        config = self._config.amplifiers[name]
        report_always = partial(self._report.add, config.wire)

        def is_disturbed(time: float) -> bool:
            return self._wires[config.wire].is_disturbed(time)

        def report(invariant: str, time: float, sentence: str) -> None:
            if not is_disturbed(time):
                report_always(invariant, time, sentence)

        slack = self._config.times.slack
        amplifier = WatchedAmplifier(name, slack=slack, report=report, report_always=report_always)
        return AmplifierSession(name, config, amplifier, report_always, report, is_disturbed)

    def record_bytes(self, link: str, direction: Direction, time: float, data: bytes) -> None:
        """Process bytes on a wire, toward the amplifier or the host."""
        self._advance(time)
        self._record(capture_line(time, link, direction, data))
        self.frames += self._wires[link].feed(direction, time, data)

    def delayed(self, until: float, duration: float) -> None:
        """Note that this program did not run for a duration [s] until a time [s].

        Deadlines of hosts and amplifiers are extended by it: what came in time was seen late.
        """
        self._deadlines.delayed(until, duration)

    def opened(self, link: str, time: float) -> None:
        """Note that a host has opened a wire: its amplifiers are not identified yet."""
        self._advance(time)
        self._wires[link].opened(time)

    def closed(self, link: str, time: float) -> None:
        """Note that the host has closed or lost a wire."""
        self._advance(time)
        self._wires[link].closed(time)

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
