"""Checks, their execution until this machine was in time, and the report of a run."""

from collections.abc import Awaitable, Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from inspect import isawaitable
from typing import Any, TypeAlias, cast

from drivers.errors import CommandError
from drivers.protocol.definition import MESSAGES, QUANTITIES, VERSION
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import FLAGS, Command, LayerSet, unpack_layers
from era_haptics.lab.conformance.judge_client import (
    BUSY,
    FEW,
    FULL,
    STATED,
    AlreadyArmed,
    Capabilities,
    CheckOutcome,
    ContractViolation,
    JudgeClient,
    NotApplicable,
    RequestRows,
    TooLate,
    UntimedClock,
    UnusableCapability,
    read_as,
    verify,
)
from era_haptics.lab.conformance.subject import Subject
from registry import threads

_MAX_TIME = 180.0  # s; after which a run begins no other check
_RETRIED = 2.0  # s; in which silence is tried again, or identification

Steps: TypeAlias = Callable[[Any], Awaitable[None] | RequestRows]
"""What a check does with a Subject, or its JudgeClient, or the rows that are carried out."""


@dataclass(frozen=True, slots=True)
class ConformanceCheck:
    """A rule of the contract: its name, what it requires, and the place that says so.

    drives: whether it arms the amplifier. kinds: of wires on which it can be tried, empty for all.
    greets: whether it needs the client alone, and nothing of the amplifier but its Hello.
    """

    name: str
    requirement: str
    place: str
    drives: bool
    kinds: tuple[str, ...]
    run: Steps
    greets: bool = False


class Result(StrEnum):
    """What a check found; skipped: there is nothing to check, as the contract allows.

    Not run: what failed before leaves it nothing to try.
    """

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"
    NOT_RUN = "not_run"


_RESULTS = {
    CheckOutcome: Result.PASSED,
    NotApplicable: Result.SKIPPED,
    TooLate: Result.SKIPPED,
    UnusableCapability: Result.NOT_RUN,
}
"""Of checks by what they found; all else has failed."""
_BARS = {
    AlreadyArmed: "it is armed, perhaps by another host",
    UntimedClock: "its clock does not go on with time, by which all that it does is judged",
}
"""Why nothing is driven once a check has found it."""


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of a check, the reason that it was not passed, and what it found."""

    check: ConformanceCheck
    number: int
    result: Result
    reason: str = ""
    finding: CheckOutcome = field(default_factory=CheckOutcome)
    seconds: float = 0.0
    attempts: int = 1

    def to_json(self) -> dict[str, Any]:
        """Make a row with stable keys."""
        return {
            "number": self.number,
            "name": self.check.name,
            "requirement": self.check.requirement,
            "place": self.check.place,
            "result": self.result.value,
            "reason": self.reason,
            "seen": self.finding.seen,
            "expected": self.finding.expected,
            "seconds": round(self.seconds, 3),
            "attempts": self.attempts,
            "sent": self.finding.sent,
            "came": self.finding.came,
        }


@dataclass(frozen=True, slots=True)
class ConformanceReport:
    """Results of checks on one amplifier; level: the highest at which channels may be driven.

    left: number of checks that were not chosen.
    """

    url: str
    level: float
    results: tuple[CheckResult, ...]
    left: int

    @property
    def driven(self) -> float:
        """The highest level at which channels were driven, 0 if none were."""
        tried = (each for each in self.results if each.result is not Result.NOT_RUN)
        return self.level * any(each.check.drives for each in tried)

    @property
    def not_run(self) -> int:
        """The number of checks that were not tried."""
        return self.left + self._counts()["not_run"]

    @property
    def overall(self) -> str:
        """The worst result: failed, incomplete or passed."""
        if any(each.result is Result.FAILED for each in self.results):
            return "failed"
        is_incomplete = self.not_run or any(
            isinstance(each.finding, TooLate) for each in self.results
        )
        return "incomplete" if is_incomplete else "passed"

    @property
    def summary(self) -> str:
        """The number of checks with each result."""
        counted = [f"{count} {name}" for name, count in [*self._counts().items()][:-1]]
        driven = f", driven at up to {self.driven:.0%} of full level" if self.driven else ""
        left = f", {self.not_run} not run" if self.not_run else ""
        return f"{', '.join(counted)}{left}{driven}"

    def to_json(self) -> dict[str, Any]:
        """Make an object with stable keys."""
        return {
            "url": self.url,
            "overall": self.overall,
            "level": self.driven,
            **self._counts(),
            "not_run": self.not_run,
            "seconds": round(sum(each.seconds for each in self.results), 3),
            "checks": [each.to_json() for each in self.results],
        }

    def _counts(self) -> dict[str, int]:
        results = [each.result for each in self.results]
        return {result.value: results.count(result) for result in Result}


def reading(
    place: str, *kinds: str, drives: bool = False, greets: bool = False
) -> Callable[[Steps], ConformanceCheck]:
    """Make a check that only reads of its steps, whose docstring begins with 'It'."""

    def make(steps: Steps) -> ConformanceCheck:
        text = " ".join((steps.__doc__ or "").split()).removeprefix("It ").removesuffix(".")
        return ConformanceCheck(
            getattr(steps, "__name__", ""), text, place, drives, kinds, steps, greets
        )

    return make


driving = partial(reading, drives=True)
"""Makes a check that arms the amplifier and drives its channels."""


async def greeted(client: JudgeClient) -> Values:
    """Read the identity of an amplifier of this version; raises ContractViolation."""
    identity = await client.hello()
    versions, client.reply_words = identity["versions"], {}
    verify(bool(versions >> VERSION & 1), "versions", expected=f"bit {VERSION} set", seen=versions)
    return identity


async def _identified(client: JudgeClient, level: float) -> Subject:
    """Identify the amplifier at the far end of a client; raises ContractViolation."""
    if client.known is None:
        identity = await greeted(client)
        answer = await client.exchange(MESSAGES["GetCaps"].number, ())
        verify(not answer.code, "GetCaps", expected="carried out", seen=answer.code)
        can = read_as("reply to GetCaps", STATED.unpack, answer.words, is_strict=False)
        client.known = Subject(client, identity, Capabilities(can), level)
    return cast(Subject, client.known)


async def run_checks(
    checks: Sequence[tuple[int, ConformanceCheck]],
    client: JudgeClient,
    *,
    level: float,
    on_result: Callable[[CheckResult], None] = lambda result: None,
    before: Sequence[CheckResult] = (),
) -> Iterable[CheckResult]:
    """Run checks in turn, each with its number, on one amplifier; return their results.

    before: results of checks that were run already. Nothing is run, and each says so, once the
    amplifier cannot be identified or silenced; nothing is driven without what is required. One for
    which this machine or the line is always too slow has no verdict. Raises LinkError for a line
    that is lost, CommandError for a level below a step.
    """
    results: list[CheckResult] = []
    began = threads.now()
    why_none = next((each.reason for each in before if each.result is Result.NOT_RUN), "")
    for number, check in checks:
        if (took := threads.now() - began) > _MAX_TIME:
            why_none = why_none or f"the time of the run is used up: {took:.0f} s"
        kinds = [type(each.finding) for each in (*before, *results)] if check.drives else []
        if why := next((_BARS[each] for each in kinds if each in _BARS), why_none):
            result = CheckResult(check, number, Result.NOT_RUN, why)
        else:
            result, why_none = await _run(number, check, client, level)
        results.append(result)
        on_result(result)
    return results


async def _run(
    number: int, check: ConformanceCheck, client: JudgeClient, level: float
) -> tuple[CheckResult, str]:
    began, doubts = threads.now(), 0
    with client.watching():
        while True:
            since, client.lag = threads.now(), 0.0
            finding, why = await _attempt(check, client, level)
            is_late = isinstance(finding, TooLate)
            # What is found while this machine is late counts once it is found again and again.
            is_doubtful = isinstance(finding, ContractViolation) and client.lag > BUSY
            doubts += is_doubtful
            if not (is_late or (is_doubtful and doubts < FEW)) or why or not client.was_late(since):
                break
    reason = str(finding)
    if is_late:
        attempts = f"in {client.attempts or 1} attempts"
        tried = "since the time of the run is used up" if client.is_used_up else attempts
        late = f"this machine was late by {1e3 * client.lag:.0f} ms"
        reason = f"no verdict {tried}: {reason}; {client.slow_reply or late}"
    if why and why != reason:
        reason = f"{reason}; then {why}"
    result = CheckResult(
        check,
        number,
        _RESULTS.get(type(finding), Result.FAILED),
        reason,
        finding,
        seconds=threads.now() - began,
        attempts=client.attempts + (not is_late),
    )
    return result, why and f"{check.name} failed"


async def _attempt(
    check: ConformanceCheck, client: JudgeClient, level: float
) -> tuple[CheckOutcome, str]:
    """Run the steps once; return what they found, and why nothing more can be run, or ""."""
    finding = CheckOutcome()
    subject: Subject | None = None
    client.heard.clear()
    try:
        if check.greets:
            await cast("Awaitable[None]", check.run(client))
        else:
            subject = await _identified(client, level)
            await _carry_out(check, subject, level)
        verify(
            not client.heard,
            "messages that were not asked for",
            expected="none",
            seen=client.heard[:1],
        )
    except CheckOutcome as found:
        finding = found
    if subject:
        subject.is_at_rest = False  # whatever it was sent
    if isinstance(finding, ContractViolation):
        finding.came = client.came.hex(" ")
        finding.sent = in_words(subject.sent_set) if subject else ""
    is_greeted = check.greets and type(finding) is CheckOutcome
    left = None if is_greeted else await _left(check, client, subject, level)
    finding = left if left and not isinstance(finding, ContractViolation) else finding
    return finding, str(left or "")


async def _carry_out(check: ConformanceCheck, subject: Subject, level: float) -> None:
    """Carry out the steps of a check, from rest if it drives."""
    subject.sent_set = []
    if check.drives:
        step = subject.can["level_step"] / FULL
        if level < step:
            raise CommandError(f"level must be at least {step:g}, its step, got {level:g}")
        if not subject.is_at_rest:
            await subject.rest()
    else:
        await subject.watch()
    rows = check.run(subject)
    await (rows if isawaitable(rows) else subject.run(rows))


async def _left(
    check: ConformanceCheck, client: JudgeClient, subject: Subject | None, level: float
) -> CheckOutcome | None:
    """Leave it silent, or identified where it was not; returns why it is not, after a few tries."""
    due = threads.now() + _RETRIED
    while subject is None or check.drives:
        try:
            with suppress(UnusableCapability):  # it is silent, but cannot be judged
                if subject:
                    await subject.rest()
                else:
                    await (greeted(client) if check.greets else _identified(client, level))
            break
        except (ContractViolation, TooLate) as found:
            if threads.now() > due + client.lag:
                return found
    return None


_TONE = ("frequency", "{:g} Hz"), ("level", "{:g}"), ("phase", "at {:g} degrees")


def in_words(parts: Sequence[Sequence[int]]) -> str:
    """Return the meaning of a set by its parts, then their words; empty without any."""
    if not parts:
        return ""
    try:
        read = [MESSAGES["Set"].request.unpack(each, is_strict=True) for each in parts]
        stream = {each["index"]: each["stream"] for each in read}
        layers = unpack_layers([word for index in sorted(stream) for word in stream[index]])
        now = "at once" if read[0]["now"] else "staged"
        meaning = "; ".join([f"set {read[0]['token']}, {now}", *map(_layer, layers)])
    except Refusal as refusal:
        meaning = f"no whole set: {refusal}"
    return f"{meaning} = {' | '.join(' '.join(f'{word:04X}' for word in each) for each in parts)}"


def _flags(one: LayerSet | Command) -> str:
    """Return what is set of a layer or a command; an envelope with its step and knots."""
    found = [(name, value) for name in FLAGS if (value := getattr(one, name, None))]
    return "".join(f" {name}" if value is True else f" {name} {value}" for name, value in found)


def _layer(one: LayerSet) -> str:
    head = f"layer {one.layer}{_flags(one)}, ramp {one.ramp} ms, valid for {one.valid_for} ms"
    return ": ".join([head, *filter(None, [", ".join(map(_tone, one.commands))])])


def _tone(one: Command) -> str:
    tone = [form.format(QUANTITIES[name].from_wire(getattr(one, name))) for name, form in _TONE]
    return f"channel {one.channel} {' '.join(tone)}{_flags(one)}"
