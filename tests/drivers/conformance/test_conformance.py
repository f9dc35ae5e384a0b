"""Conformance checks against amplifiers with one mistake each."""

import time
from collections.abc import Callable
from dataclasses import replace

import pytest

from drivers.amplifier import Amplifier
from drivers.backend import Backend
from drivers.command import CommandSet
from drivers.conformance import CHECKS, run_check
from drivers.protocol.messages import (
    Achieved,
    Apply,
    Arm,
    Capabilities,
    Clear,
    Commit,
    Disarm,
    Identity,
    LoadEnvelope,
    Nak,
    Reply,
    Request,
    Stage,
    Status,
    Stop,
)
from sim.amplifier.amplifier import SimulatedAmplifier

Answer = Callable[[SimulatedAmplifier, Request, float], Reply]


def honest(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Reply as specified."""
    return amplifier.handle(request, now)


class Flawed(Backend):
    """A simulated amplifier in this process with altered replies."""

    def __init__(self, answer: Answer) -> None:
        self._amplifier = SimulatedAmplifier("main", channels=4)
        self._answer = answer

    async def open(self) -> None:
        """Nothing to open."""

    async def close(self) -> None:
        """Nothing to close."""

    @property
    def last_sent(self) -> float:
        """Not of interest here."""
        return 0.0

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Answered at once."""
        return self._answer(self._amplifier, request, time.monotonic())


def forgets_tokens(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Plays a repeated token once more."""
    if isinstance(request, Apply):
        amplifier._sets.tokens.clear()
        amplifier._sets.active = None
    return amplifier.handle(request, now)


def drops_bad_channels(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Plays what it can of a set instead of refusing it."""
    if isinstance(request, Apply):
        asked = request.command_set
        good = tuple(one for one in asked.commands if one.channel < 4)
        request = Apply(CommandSet(asked.token, good, asked.ramp, asked.valid_for))
    return amplifier.handle(request, now)


def promises_more(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Answers with what was asked instead of what is played."""
    reply = amplifier.handle(request, now)
    if isinstance(request, Apply) and isinstance(reply, Achieved):
        louder = tuple(replace(one, level=one.level + 0.01) for one in reply.commands)
        return replace(reply, commands=louder)
    return reply


def plays_on_stage(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Does not wait for the commit."""
    if isinstance(request, Stage):
        return amplifier.handle(Apply(request.command_set), now)
    return amplifier.handle(request, now)


def knows_no_ramp(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Jumps."""
    if isinstance(request, Apply):
        asked = request.command_set
        jump = CommandSet(asked.token, asked.commands, 0.0, asked.valid_for)
        return amplifier.handle(Apply(jump), now)
    return amplifier.handle(request, now)


def clears_by_itself(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Arms out of a latched stop or fault."""
    if isinstance(request, Arm):
        amplifier.handle(Clear(), now)
    return amplifier.handle(request, now)


def keeps_high_voltage(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """The high voltage stays on."""
    reply = amplifier.handle(request, now)
    return replace(reply, high_voltage=True) if isinstance(reply, Status) else reply


def is_fed_by_looking_on(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Any request feeds the watchdog."""
    reply = amplifier.handle(request, now)
    amplifier._fed = now
    return reply


def ignores_disarm(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Says yes and plays on."""
    return amplifier.status(now) if isinstance(request, Disarm) else amplifier.handle(request, now)


def ignores_valid_for(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Plays for ever."""
    reply = amplifier.handle(request, now)
    amplifier._vibration_end = float("inf")
    return reply


def ignores_endings(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Takes an envelope and does not play it."""
    if isinstance(request, Apply):
        amplifier._channels._endings = {}
    return amplifier.handle(request, now)


def keeps_empty_slots(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Never forgets an envelope."""
    kept = dict(amplifier._sets.slots)
    reply = amplifier.handle(request, now)
    if isinstance(request, LoadEnvelope):
        amplifier._sets.slots = kept | amplifier._sets.slots
    return reply


def has_no_serial_number(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """No serial number."""
    reply = amplifier.handle(request, now)
    return replace(reply, serial_number="") if isinstance(reply, Identity) else reply


def has_no_range(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """A range of frequencies without an end."""
    reply = amplifier.handle(request, now)
    return replace(reply, level_max=0.0) if isinstance(reply, Capabilities) else reply


def commits_anything(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Plays what is staged whatever token is named."""
    if isinstance(request, Commit) and amplifier._sets.staged is not None:
        reply = amplifier.handle(Commit(amplifier._sets.staged.token), now)
        return Achieved(request.token, ()) if isinstance(reply, Achieved) else reply
    return amplifier.handle(request, now)


def is_never_silent(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """A set without channels changes nothing."""
    if isinstance(request, Apply) and not request.command_set.commands:
        return Achieved(request.command_set.token, ())
    return amplifier.handle(request, now)


def stop_does_not_latch(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """After a stop it is merely disarmed."""
    if isinstance(request, Stop):
        amplifier.handle(request, now)
        return amplifier.handle(Clear(), now)
    return amplifier.handle(request, now)


def does_not_beat(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Nothing but arming fills the watchdog."""
    fed = amplifier._fed
    reply = amplifier.handle(request, now)
    if not isinstance(request, Arm) and not isinstance(reply, Nak):
        amplifier._fed = fed
    return amplifier.status(now) if isinstance(reply, Status) else reply


MISTAKES: list[tuple[Answer, str]] = [
    (has_no_serial_number, "identity"),
    (has_no_range, "capabilities"),
    (keeps_high_voltage, "starts_disarmed"),
    (promises_more, "achieved"),
    (is_never_silent, "unnamed_channels"),
    (drops_bad_channels, "all_or_nothing"),
    (plays_on_stage, "stage_and_commit"),
    (commits_anything, "stage_and_commit"),
    (forgets_tokens, "tokens"),
    (knows_no_ramp, "ramps"),
    (stop_does_not_latch, "quick_stop"),
    (clears_by_itself, "quick_stop"),
    (ignores_disarm, "disarm"),
    (does_not_beat, "heartbeats"),
    (ignores_valid_for, "valid_for"),
    (is_fed_by_looking_on, "watchdog"),
    (ignores_endings, "envelopes"),
    (keeps_empty_slots, "missing_envelopes"),
]


@pytest.mark.parametrize(
    ("answer", "name"), MISTAKES, ids=[answer.__name__ for answer, _ in MISTAKES]
)
async def test_check_fails_for_its_mistake_only(
    answer: Answer, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The check it is for says what happened instead; an honest amplifier passes that check."""
    monkeypatch.setattr("drivers.conformance.bench.EVENT_TIMEOUT", 1.0)
    (check,) = [check for check in CHECKS if check.name == name]
    outcomes = []
    for behaviour in (answer, honest):
        amplifier = Amplifier(Flawed(behaviour))
        await amplifier.open()
        outcomes.append(await run_check(check, amplifier))
    assert outcomes[0].problem
    assert outcomes[1].problem is None


def test_reading_checks_come_first() -> None:
    """Nothing is driven before."""
    drives = [check.drives for check in CHECKS]
    assert drives == sorted(drives)
    assert drives.count(False) >= 4
    assert all(check.proves for check in CHECKS)
