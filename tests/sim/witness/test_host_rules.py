"""What a host owes its amplifiers, and what it owes no more."""

import pytest

from sim.witness.amplifier_session import AmplifierSession
from sim.witness.config import AmplifierConfig, ChannelLimits, TimeLimits
from sim.witness.decoded import ChannelCommand, Reply, Request, RequestKind, Status
from sim.witness.delays import Delays
from sim.witness.host_rules import HostRules
from sim.witness.reference_amplifier import ReferenceAmplifier

ARM = Request(RequestKind.ARM, 1, key=1, watchdog=0.25)
DISARM = Request(RequestKind.DISARM, 1, key=2, ramp=0.05)
STOP = Request(RequestKind.STOP, 1, key=3, ramp=0.005)
SET = Request(
    RequestKind.APPLY, 1, key=4, token=5, ramp=0.01, commands={0: ChannelCommand(110.0, 0.2, 0.0)}
)
SILENT = Request(
    RequestKind.APPLY, 1, key=5, token=6, ramp=0.01, commands={0: ChannelCommand(110.0, 0.0, 0.0)}
)
NEXT = Request(
    RequestKind.APPLY, 1, key=6, token=7, ramp=0.01, commands={0: ChannelCommand(110.0, 0.3, 0.0)}
)
ENABLED = Status(4, 0)


class Watched:
    """A host of two armed amplifiers on wires of their own, and the rules that it breaks."""

    def __init__(self) -> None:
        self.broken: list[str] = []
        self.sessions = {name: self._session(name) for name in ("west", "east")}
        self.host = HostRules(self.sessions, times=TimeLimits(), delays=Delays())
        for session in self.sessions.values():
            session.amplifier.request_granted(ARM, Reply(1, ARM.key, status=ENABLED), 1.0, 1.001)

    def _session(self, name: str) -> AmplifierSession:
        plan = AmplifierConfig(
            wire=name, channels={0: ChannelLimits(frequency_hz=(40.0, 500.0), level=1.0)}
        )
        amplifier = ReferenceAmplifier(
            name,
            plan,
            times=TimeLimits(),
            report=self._report,
            report_always=self._report,
        )
        return AmplifierSession(name, plan, amplifier, self._report, lambda time: False)

    def _report(self, invariant: str, time: float, sentence: str) -> None:
        self.broken.append(invariant)


@pytest.mark.parametrize(
    ("closed", "broken"),
    [
        ((), ["commit"]),
        (("east",), ["commit"]),  # a host that lost one can silence the other
        (("west", "east"), []),  # no host is left
    ],
)
def test_host_rules_require_a_set_on_all_amplifiers(
    closed: tuple[str, ...], broken: list[str]
) -> None:
    """A set goes to one of two amplifiers only, then 20 ms pass."""
    watched = Watched()
    watched.host.check_request(watched.sessions["west"], 1.01, SET)
    for name in closed:
        watched.sessions[name].is_open = False
    watched.host.advance(1.05)
    assert watched.broken == broken


def test_host_rules_require_silence_before_another_set() -> None:
    """One plays a set, the last finger lifts before the other does, and for the next finger both
    play another one: only if the first was silenced in between."""
    for silences, broken in (((SILENT,), []), ((), ["commit"])):
        watched = Watched()
        watched.host.check_request(watched.sessions["west"], 1.010, SET)
        for silent in silences:
            watched.host.check_request(watched.sessions["west"], 1.014, silent)
        for session in watched.sessions.values():
            watched.host.check_request(session, 1.020, NEXT)
        watched.host.advance(1.05)
        assert watched.broken == broken


def test_host_rules_accept_a_request_on_its_way_at_the_stop() -> None:
    """Seen less than a millisecond after the stop was requested, it was written before."""
    watched = Watched()
    watched.host.operator_command(1.010, "stop")
    watched.host.check_request(
        watched.sessions["west"], 1.0108, Request(RequestKind.STATUS, 1, key=9)
    )
    watched.host.check_request(watched.sessions["west"], 1.014, STOP)
    assert watched.broken == []


def test_host_rules_report_a_disarm_before_a_stop() -> None:
    """A stop is requested, but a disarm with ten times the ramp is sent first."""
    watched = Watched()
    watched.host.operator_command(1.010, "stop")
    watched.host.check_request(watched.sessions["west"], 1.012, DISARM)
    watched.host.check_request(watched.sessions["west"], 1.014, STOP)
    assert watched.broken == ["stop"]
