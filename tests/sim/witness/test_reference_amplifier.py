"""The reference model of an amplifier."""

import pytest

from sim.witness.config import AmplifierConfig, ChannelLimits, TimeLimits
from sim.witness.decoded import ChannelCommand, Reply, Request, RequestKind, Status
from sim.witness.reference_amplifier import ReferenceAmplifier

PLAN = AmplifierConfig(
    wire="line", channels={0: ChannelLimits(frequency_hz=(40.0, 500.0), level=1.0)}
)
ARM = Request(RequestKind.ARM, 1, key=1, watchdog=0.25)
STOP = Request(RequestKind.STOP, 1, key=2)
DISARM = Request(RequestKind.DISARM, 1, key=4, ramp=0.05)
STATUS = Request(RequestKind.STATUS, 1, key=5)
CLEAR = Request(RequestKind.CLEAR, 1, key=6)
STOP_ALL = Request(RequestKind.STOP, 0)
# Plays 0.2 for 0.3 s, then fades out along 50 ms.
BRIEF = Request(
    RequestKind.APPLY,
    1,
    key=3,
    token=1,
    ramp=0.05,
    valid_for=0.3,
    commands={0: ChannelCommand(110.0, 0.2, 0.0)},
)
# docs/reference/wire-protocol.md, States and Fault.
SWITCHED_ON, ENABLED, STOPPED, REACTING, FAULT = 3, 4, 5, 6, 7
WATCHDOG = 1


class Watched:
    """A follower with the rules that it finds broken."""

    def __init__(self, *, slack: float = 0.001) -> None:
        self.broken: list[str] = []
        times = TimeLimits(slack=slack)
        self.amplifier = ReferenceAmplifier(
            "main",
            PLAN,
            times=times,
            report=self._report,
            report_always=self._report,
        )

    def grants(self, request: Request, begin: float, state: int, fault: int = 0) -> None:
        """A request at a time [s], and an answer 2 ms later that says how it is."""
        status = Status(state, fault, high_voltage=state == ENABLED)
        answer = Reply(1, request.key, status=status)
        self.amplifier.request_granted(request, answer, begin, begin + 0.002)

    def _report(self, invariant: str, time: float, sentence: str) -> None:
        self.broken.append(invariant)


def test_reference_accepts_a_fault_from_an_unknown_state() -> None:
    """Armed, state unknown, stopped: its watchdog may have expired meanwhile."""
    watched = Watched()
    watched.grants(ARM, 1.0, ENABLED)
    watched.amplifier.forget_state()
    watched.grants(STOP, 9.0, FAULT, WATCHDOG)
    assert watched.broken == []


def test_reference_forgets_an_unobserved_fault() -> None:
    """In a fault, state unknown, cleared and armed meanwhile, stopped."""
    watched = Watched()
    watched.grants(ARM, 1.0, ENABLED)
    watched.amplifier.event_received(FAULT, WATCHDOG, 2.0)
    watched.amplifier.forget_state()
    watched.grants(STOP, 9.0, STOPPED)
    assert watched.broken == []


@pytest.mark.parametrize(("time", "broken"), [(1.255, ["latched"]), (1.5, [])])
def test_reference_knows_that_a_fault_reaction_ends(time: float, broken: list[str]) -> None:
    """Clear ends a fault once silent, 5 ms after it began, also if that event was not heard."""
    watched = Watched()
    watched.grants(ARM, 1.0, ENABLED)
    watched.amplifier.event_received(REACTING, WATCHDOG, 1.252)
    watched.grants(CLEAR, time, 1)
    assert watched.broken == broken


def test_reference_reports_an_early_watchdog_fault() -> None:
    """Ten milliseconds after Arm no watchdog of 250 ms has run out."""
    watched = Watched()
    watched.grants(ARM, 1.0, ENABLED)
    watched.grants(STOP, 1.01, FAULT, WATCHDOG)
    assert watched.broken == ["watchdog"]


@pytest.mark.parametrize("state", [1, 3, ENABLED])
def test_reference_reports_an_ignored_stop(state: int) -> None:
    """From every state Stop leads to one that is latched."""
    watched = Watched()
    watched.grants(STOP, 1.0, state)
    assert len(watched.broken) == 1


@pytest.mark.parametrize(
    ("time", "level", "rules"),
    [
        (1.370, 0.2, []),
        (1.370, 0.18, ["plays"]),
        (1.402, 0.2, []),
        (1.410, 0.1809, []),
        (1.410, 0.0, ["ramp"]),
        (1.460, 0.0, []),
        (1.460, 0.2, ["silent"]),
    ],
)
def test_reference_fades_at_the_end_of_a_set(time: float, level: float, rules: list[str]) -> None:
    """Taken at 1.100 to 1.102 s, it fades from 1.4 s on: 0.2 (1 + cos(pi/5)) / 2 after 10 ms."""
    watched = Watched(slack=0.02)
    watched.grants(ARM, 1.0, ENABLED)
    watched.amplifier.request_granted(BRIEF, Reply(1, 3), 1.1, 1.102)
    watched.amplifier.feed(1.3)
    watched.amplifier.status_reported(Status(ENABLED, 0, levels=(level,)), time, time + 0.001)
    assert watched.broken == rules


def test_reference_accepts_any_output_in_an_unknown_state() -> None:
    """The set that ended at 1.4 s may have been followed by another."""
    watched = Watched()
    watched.grants(ARM, 1.0, ENABLED)
    watched.amplifier.request_granted(BRIEF, Reply(1, 3), 1.1, 1.102)
    watched.amplifier.forget_state()
    for time in (1.35, 1.6):
        watched.amplifier.status_reported(Status(ENABLED, 0, levels=(0.2,)), time, time + 0.001)
    assert watched.broken == []


@pytest.mark.parametrize(
    ("request_", "says"),
    [(DISARM, SWITCHED_ON), (STATUS, ENABLED), (ARM, ENABLED), (BRIEF, ENABLED)],
)
def test_reference_accepts_a_reply_overtaken_by_a_broadcast_stop(
    request_: Request, says: int
) -> None:
    """The reply reports how it was before the stop, which holds all the same."""
    watched = Watched()
    if request_ is not ARM:
        watched.grants(ARM, 1.0, ENABLED)
    else:
        watched.amplifier.restarted(1.0)
    watched.amplifier.broadcast_sent(STOP_ALL, 1.1)
    reply = Reply(1, request_.key, status=Status(says, 0))
    watched.amplifier.granted_before_stop(request_, reply, 1.0995, 1.1005)
    watched.grants(STATUS, 1.12, STOPPED)
    assert watched.broken == []
    watched.grants(STATUS, 1.2, ENABLED)
    assert watched.broken == ["armed"]


@pytest.mark.parametrize(("time", "broken"), [(1.1095, []), (1.1105, ["armed"])])
def test_reference_expects_a_broadcast_stop_within_10_ms(time: float, broken: list[str]) -> None:
    """Until then an event may still report how it was before."""
    watched = Watched()
    watched.grants(ARM, 1.0, ENABLED)
    watched.amplifier.broadcast_sent(STOP_ALL, 1.1)
    watched.amplifier.event_received(ENABLED, 0, time)
    assert watched.broken == broken


def test_reference_follows_a_fault_that_crosses_a_broadcast_stop() -> None:
    """FAULT reported while the Stop is on its way; Clear then leads out of it."""
    watched = Watched()
    watched.grants(ARM, 1.0, ENABLED)
    watched.amplifier.event_received(REACTING, WATCHDOG, 1.255)
    watched.amplifier.broadcast_sent(STOP_ALL, 1.2552)
    watched.amplifier.event_received(FAULT, WATCHDOG, 1.2553)
    watched.grants(Request(RequestKind.CLEAR, 1, key=6), 1.4, 1)
    assert watched.broken == []


@pytest.mark.parametrize(("silent_at", "broken"), [(1.262, []), (1.272, ["watchdog"])])
def test_reference_allows_10_ms_for_a_request_without_a_reply(
    silent_at: float, broken: list[str]
) -> None:
    """Sent at 1.000 s, it may feed until 1.010 s: silent from 1.260 s and a ramp of 5 ms on."""
    watched = Watched()
    watched.grants(ARM, 0.8, ENABLED)
    watched.amplifier.request_granted(BRIEF, Reply(1, 3), 0.9, 0.902)
    watched.amplifier.may_feed(1.0)
    watched.amplifier.check_sensors((0.1,), {}, silent_at)
    assert [rule for rule in watched.broken if rule != "plays"] == broken


@pytest.mark.parametrize(("stopped_at", "broken"), [(1.253, []), (1.1, ["watchdog"])])
def test_reference_expects_no_feed_from_a_request_after_the_watchdog(
    stopped_at: float, broken: list[str]
) -> None:
    """A reply that reports the watchdog's fault tells of what was before its request."""
    watched = Watched()
    watched.grants(ARM, 1.0, ENABLED)
    watched.grants(STOP, stopped_at, REACTING, WATCHDOG)
    assert watched.broken == broken


def test_reference_allows_a_set_again_once_the_active_one_is_unknown() -> None:
    """Its reply, late, and that of its repetition, both grant one set."""
    watched = Watched()
    watched.grants(ARM, 1.0, ENABLED)
    watched.amplifier.request_granted(BRIEF, Reply(1, 3), 1.1, 1.102)
    watched.amplifier.forget_state()
    watched.amplifier.request_granted(BRIEF, Reply(1, 3), 1.12, 1.122)
    assert watched.broken == []


def test_reference_allows_10_ms_for_a_heartbeat_without_a_reply() -> None:
    """Sent at 1.000 s; 3 ms after 1.250 s the fade of 5 ms may have begun or not."""
    watched = Watched()
    watched.grants(ARM, 0.8, ENABLED)
    watched.amplifier.request_granted(
        Request(
            RequestKind.APPLY, 1, key=3, token=1, commands={0: ChannelCommand(110.0, 0.2, 0.0)}
        ),
        Reply(1, 3),
        0.9,
        0.902,
    )
    watched.amplifier.feed(1.0)
    watched.grants(STOP, 1.252, REACTING, WATCHDOG)
    watched.amplifier.check_sensors((0.19,), {}, 1.2535)
    watched.amplifier.check_sensors((0.0,), {}, 1.258)
    assert watched.broken == []


def test_reference_knows_that_hosts_need_not_read_the_state_in_a_refusal() -> None:
    """The fault is known from then on, but not as answered; a reply makes it so."""
    watched = Watched()
    watched.grants(ARM, 1.0, ENABLED)
    watched.amplifier.refusal_received(Status(FAULT, WATCHDOG), 1.251, 1.255)
    assert watched.amplifier.is_in_fault
    assert not watched.amplifier.is_answered
    watched.amplifier.status_reported(Status(FAULT, WATCHDOG), 1.26, 1.262)
    assert watched.amplifier.is_answered
    assert watched.broken == []
