"""Conformance checks against amplifiers with one mistake each."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.backend import Backend
from drivers.command import CommandSet
from drivers.conformance import CHECKS, run_check
from drivers.protocol.messages import (
    Achieved,
    AmplifierState,
    Apply,
    Arm,
    Capabilities,
    Clear,
    Commit,
    Disarm,
    Identity,
    LoadEnvelope,
    Nak,
    Ping,
    Reply,
    Request,
    Stage,
    Status,
    Stop,
)
from sim.amplifier.amplifier import SimulatedAmplifier
from sim.waveform import FadingTone
from vendor_pages import plain
from virtual_loop import in_virtual_time

Answer = Callable[[SimulatedAmplifier, Request, float], Reply]
Deed = Callable[[SimulatedAmplifier, float], None]


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
    def last_sent_at(self) -> float:
        return 0.0

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        return self._answer(self._amplifier, request, clock.now())


def altered_reply(kind: type[Any], **changes: object) -> Answer:
    """Alter every reply of a kind."""

    def answer(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
        reply = amplifier.handle(request, now)
        return replace(reply, **changes) if isinstance(reply, kind) else reply

    return answer


def altered_request(kind: type[Any], alter: Callable[[Any], Request]) -> Answer:
    """Carry out another request instead of one of a kind."""

    def answer(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
        return amplifier.handle(alter(request) if isinstance(request, kind) else request, now)

    return answer


def altered_set(alter: Callable[[CommandSet], dict[str, Any]]) -> Answer:
    """Apply another set."""
    return altered_request(
        Apply,
        lambda asked: Apply(
            replace(plain(asked).command_set, **alter(asked.command_set)), asked.session
        ),
    )


def void(amplifier: SimulatedAmplifier, now: float) -> None:
    """Do nothing."""


def clear(amplifier: SimulatedAmplifier, now: float) -> None:
    """Acknowledge a stop or fault."""
    amplifier.handle(Clear(amplifier.latch), now)


def beside(kind: type[Any], *, before: Deed = void, after: Deed = void) -> Answer:
    """Do something before or after a request of a kind."""

    def answer(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
        is_wanted = isinstance(request, kind)
        (before if is_wanted else void)(amplifier, now)
        reply = amplifier.handle(request, now)
        (after if is_wanted else void)(amplifier, now)
        return reply

    return answer


def forget_tokens(amplifier: SimulatedAmplifier, now: float) -> None:
    """Forget which set has been played."""
    amplifier._sets.active = None


def ignore_contents(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Confirm any set with the active token."""
    active = amplifier._sets.active
    if isinstance(request, Apply) and active and request.command_set.token == active.token:
        return active.achieved
    return amplifier.handle(request, now)


def extend_ramp(amplifier: SimulatedAmplifier, now: float) -> None:
    """Begin the ramp to silence anew."""
    channels = amplifier._channels
    channels._outputs = [
        tuple(replace(tone, start=now, ramp=1.0, gain_to=1.0) for tone in output)
        for output in channels._outputs
        if all(isinstance(tone, FadingTone) for tone in output)
    ]


def keep_staged(amplifier: SimulatedAmplifier, now: float) -> None:
    """Let no staged set grow old."""
    amplifier._sets._staged_at = now


def promises_more(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Report a higher level than is played."""
    reply = amplifier.handle(request, now)
    if isinstance(request, Apply) and isinstance(reply, Achieved):
        louder = tuple(replace(one, level=one.level + 0.01) for one in reply.commands)
        return replace(reply, commands=louder)
    return reply


def keeps_empty_slots(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Keep an envelope when its slot is emptied."""
    kept = dict(amplifier._sets.slots)
    reply = amplifier.handle(request, now)
    if isinstance(request, LoadEnvelope):
        amplifier._sets.slots = kept | amplifier._sets.slots
    return reply


def commits_anything(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Play the staged set whatever the token."""
    if isinstance(request, Commit) and amplifier._sets.staged is not None:
        reply = amplifier.handle(Commit(amplifier._sets.staged.token, request.session), now)
        return Achieved(request.token, ()) if isinstance(reply, Achieved) else reply
    return amplifier.handle(request, now)


def is_never_silent(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Ignore a set without channels."""
    if isinstance(request, Apply) and not request.command_set.commands:
        return Achieved(request.command_set.token, ())
    return amplifier.handle(request, now)


def ignores_disarm(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Confirm a disarm and play on."""
    return amplifier.status(now) if isinstance(request, Disarm) else amplifier.handle(request, now)


def does_not_beat(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
    """Feed the watchdog by arming only."""
    fed = amplifier._last_fed
    reply = amplifier.handle(request, now)
    if not isinstance(request, Arm) and not isinstance(reply, Nak):
        amplifier._last_fed = fed
    return amplifier.status(now) if isinstance(reply, Status) else reply


def obeys_any_session(kind: type[Any]) -> Answer:
    """Carry out requests of a kind whatever their session."""

    def answer(amplifier: SimulatedAmplifier, request: Request, now: float) -> Reply:
        if isinstance(request, kind):
            request = replace(request, session=amplifier.session)
        return amplifier.handle(request, now)

    return answer


def forget_session(amplifier: SimulatedAmplifier, now: float) -> None:
    """Forget which session has ended."""
    if amplifier.state is not AmplifierState.OPERATION_ENABLED:
        amplifier.session = 0


def silences(amplifier: SimulatedAmplifier, now: float) -> None:
    """Begin anew at level zero."""
    amplifier._silence(now, ramp=0.0)


MISTAKES: list[tuple[str, Answer]] = [
    ("identity", altered_reply(Identity, serial_number="")),
    ("capabilities", altered_reply(Capabilities, level_max=0.0)),
    ("starts_disarmed", altered_reply(Status, high_voltage=True)),
    ("achieved", promises_more),
    ("unnamed_channels", is_never_silent),
    (
        "all_or_nothing",
        altered_set(lambda asked: {"commands": tuple(c for c in asked.commands if c.channel < 4)}),
    ),
    (
        "stage_and_commit",
        altered_request(Stage, lambda stage: Apply(stage.command_set, stage.session)),
    ),
    ("stage_and_commit", commits_anything),
    ("tokens", beside(Apply, before=forget_tokens)),
    ("tokens", ignore_contents),
    ("staged_sets_expire", beside(Commit, before=keep_staged)),
    ("ramps", altered_set(lambda asked: {"ramp": 0.0})),
    *(("sessions", obeys_any_session(kind)) for kind in (Apply, Stage, Ping, Arm)),
    ("sessions", beside(Arm, before=forget_session)),
    ("sessions", beside(Arm, before=silences)),
    ("quick_stop", beside(Stop, after=clear)),
    ("clear_names_the_stop", altered_reply(Status, latch=1)),
    ("clear_names_the_stop", beside(Clear, before=lambda one, now: setattr(one, "latch", 1))),
    ("silence_never_later", beside(Stop, before=extend_ramp)),
    ("quick_stop", beside(Arm, before=clear)),
    ("disarm", ignores_disarm),
    ("heartbeats", does_not_beat),
    ("valid_for", beside(object, after=lambda one, now: setattr(one, "_vibration_end", math.inf))),
    ("watchdog", beside(object, after=lambda one, now: setattr(one, "_last_fed", now))),
    ("envelopes", beside(Apply, before=lambda one, now: setattr(one._channels, "_endings", {}))),
    ("missing_envelopes", keeps_empty_slots),
]


@pytest.mark.parametrize(("name", "answer"), MISTAKES)
@in_virtual_time
async def test_check_fails_for_its_mistake_only(name: str, answer: Answer) -> None:
    """An amplifier without the mistake passes."""
    (check,) = [check for check in CHECKS if check.name == name]
    outcomes = []
    for behaviour in (answer, SimulatedAmplifier.handle):
        amplifier = Amplifier(Flawed(behaviour))
        await amplifier.open()
        outcomes.append(await run_check(check, amplifier))
    assert outcomes[0].problem
    assert outcomes[1].problem is None


def test_reading_checks_come_first() -> None:
    """Each check has its mistake above, except those that others cannot pass without."""
    drives = [check.drives for check in CHECKS]
    assert drives == sorted(drives)
    assert drives.count(False) >= 4
    untested = {check.name for check in CHECKS} - {name for name, _ in MISTAKES}
    assert untested == {"reading_changes_nothing", "plays_nothing_disarmed", "cancelled_requests"}
