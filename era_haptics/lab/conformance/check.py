"""Conformance checks, their runner, which repeats those this machine disturbed, and the report."""

import re
from collections.abc import Awaitable, Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from inspect import getdoc, isawaitable
from typing import Any, TypeAlias, cast

from drivers.errors import CommandError
from drivers.protocol.definition import MESSAGES, QUANTITIES, VERSION
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import FLAGS, Command, Envelope, LayerSet, unpack_layers
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

_MAX_TIME = 180.0  # s; a run starts no further check after this time
_RETRIED = 2.0  # s; for repeated attempts to silence or identify the amplifier

Steps: TypeAlias = Callable[[Any], Awaitable[None] | RequestRows]
"""Steps of a check: a coroutine for a Subject or its JudgeClient, or rows to carry out."""


@dataclass(frozen=True, slots=True)
class ConformanceCheck:
    """Check of a protocol rule.

    title: stimulus and required reaction. place: page and heading of the rule, as an anchor.
    drives: whether it arms the amplifier. kinds: kinds of wire it applies to, empty for all.
    greets: whether it uses only Hello. remedy: what to change in the firmware if it fails.
    """

    name: str
    title: str
    place: str
    drives: bool
    kinds: tuple[str, ...]
    run: Steps
    greets: bool = False
    remedy: str = ""


class Result(StrEnum):
    """Result of a check.

    skipped: the protocol allows the amplifier to lack what is checked, or there is no verdict.
    not_run: an earlier failure prevents the check.
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
"""Results by outcome; any other outcome is a failure."""
_BARS = {
    AlreadyArmed: "the amplifier is already armed, perhaps by another host",
    UntimedClock: "the amplifier's clock does not advance with time; timing checks depend on it",
}
"""Outcomes after which no check may drive the amplifier, with the reason."""


@dataclass(frozen=True, slots=True)
class SharedValue:
    """A value that many checks compare, and what to change if it is wrong.

    pattern: how a reason about it begins. anchors: of the headings in protocol.md whose checks
    have it as their subject, so that their own remedy applies; the first one has its rule.
    """

    name: str
    pattern: str
    anchors: tuple[str, ...]
    remedy: str

    @property
    def place(self) -> str:
        """Page and heading of its rule."""
        return f"protocol.md#{self.anchors[0]}"

    def is_in(self, reason: str) -> bool:
        """Whether a reason is about this value."""
        return re.match(self.pattern, reason) is not None


_PLAYING = ("layers", "ramps-and-envelopes", "voices", "sum-of-a-channel", "the-clock")
SHARED_VALUES = (
    SharedValue(
        "level of a channel",
        r"level of channel .* after set",
        ("readings", *_PLAYING, "start-of-a-set"),
        "In Status, show the amplitude that each channel has at `clock`, channel 0 first: the sum "
        "of the magnitudes of all its voices, during a ramp too.",
    ),
    SharedValue(
        "token of a layer",
        "token of layer",
        ("readings", *_PLAYING, "start-of-a-set", "sets"),
        "In Status, show the token of the set that each layer plays, 0 for a layer that is over.",
    ),
    SharedValue(
        "token",
        "token after",
        ("readings", "start-of-a-set", "sets", "parts-of-a-set"),
        "In Status, show the token committed last since Arm, or 0.",
    ),
    SharedValue(
        "exact",
        "exact of set",
        ("parts-of-a-set", "readings", "identity-and-capabilities"),
        "In Taken, set exact if the whole set plays without rounding, else state your steps.",
    ),
    SharedValue(
        "missing, staged, played",
        "missing, staged, played",
        ("parts-of-a-set", "start-of-a-set", "sets"),
        "In Taken, report the first missing part, or else that the set is staged or played.",
    ),
    SharedValue(
        "watchdog_left",
        "watchdog_left",
        ("sessions-and-the-watchdog",),
        "Count down from the time of Arm, restart with each request that feeds, and show the "
        "time left in ms; 0 unless armed.",
    ),
    SharedValue(
        "latch",
        "latch after",
        ("states",),
        "Give every Stop and every fault the next number of a 16-bit latch, and show it in Status.",
    ),
    SharedValue(
        "high_voltage",
        "high_voltage in",
        ("readings", "states"),
        "Set the flag high_voltage in the states 3 and 4, and in 5 until silent.",
    ),
    SharedValue(
        "state",
        "state .* s after",
        ("states", "sessions-and-the-watchdog"),
        "Compare your changes of state and their times with the tables of states and times.",
    ),
)


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of a check, with the reason unless it passed."""

    check: ConformanceCheck
    number: int
    result: Result
    reason: str = ""
    finding: CheckOutcome = field(default_factory=CheckOutcome)
    seconds: float = 0.0
    attempts: int = 1

    @property
    def advice(self) -> tuple[str, str]:
        """Page and heading of the violated rule, and the remedy.

        They belong to the check, unless a value failed that is the subject of other checks.
        """
        for value in SHARED_VALUES:
            anchor = self.check.place.partition("#")[2]
            if value.is_in(self.reason) and anchor not in value.anchors:
                return value.place, value.remedy
        return self.check.place, self.check.remedy

    def to_json(self) -> dict[str, Any]:
        """Return a row with stable keys."""
        is_failed = self.result is Result.FAILED
        return {
            "number": self.number,
            "name": self.check.name,
            "requirement": self.check.title,
            "place": self.check.place,
            "result": self.result.value,
            "reason": self.reason,
            "seen": self.finding.seen,
            "expected": self.finding.expected,
            "seconds": round(self.seconds, 3),
            "attempts": self.attempts,
            "sent": self.finding.sent,
            "came": self.finding.came,
            "remedy": self.advice[1] if is_failed else "",
        }


@dataclass(frozen=True, slots=True)
class ConformanceReport:
    """Results of an amplifier's checks.

    level: highest level at which channels may be driven. left: number of checks left out.
    """

    url: str
    level: float
    results: tuple[CheckResult, ...]
    left: int

    @property
    def driven(self) -> float:
        """Highest level at which channels were driven, 0 if none were."""
        is_driven = any(
            row.check.drives and row.result is not Result.NOT_RUN for row in self.results
        )
        return self.level * is_driven

    @property
    def not_run(self) -> int:
        """Number of checks that were not run."""
        return self.left + self._counts()["not_run"]

    @property
    def overall(self) -> str:
        """Overall result: failed, incomplete or passed."""
        if any(each.result is Result.FAILED for each in self.results):
            return "failed"
        is_incomplete = self.not_run or any(
            isinstance(each.finding, TooLate) for each in self.results
        )
        return "incomplete" if is_incomplete else "passed"

    @property
    def summary(self) -> str:
        """Number of checks with each result, as a sentence."""
        counted = [f"{count} {name}" for name, count in [*self._counts().items()][:-1]]
        without_verdict = [row for row in self.results if isinstance(row.finding, TooLate)]
        if without_verdict:
            counted[-1] += f" ({len(without_verdict)} without a verdict; run again)"
        driven = f", driven at up to {self.driven:.0%} of full level" if self.driven else ""
        left = f", {self.not_run} not run" if self.not_run else ""
        return f"{', '.join(counted)}{left}{driven}"

    @property
    def fix_first(self) -> list[str]:
        """Values that made several checks fail, the most frequent first, with rule and remedy."""
        reasons = [row.reason for row in self.results if row.result is Result.FAILED]
        shared: list[tuple[int, str]] = []
        for value in SHARED_VALUES:
            count = sum(value.is_in(reason) for reason in reasons)
            if count > 1:
                shared.append((count, f"{value.name} in {count} checks ({value.place})"))
        shared.sort(key=lambda pair: pair[0], reverse=True)
        return [text for _, text in shared]

    def to_json(self) -> dict[str, Any]:
        """Return an object with stable keys."""
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
    """Decorate the steps of a check that only reads.

    The first paragraph of their docstring is the title, the second one the remedy.
    """

    def make(steps: Steps) -> ConformanceCheck:
        name = getattr(steps, "__name__", "")
        title, _, remedy = (getdoc(steps) or "").partition("\n\n")
        title = " ".join(title.split()).removesuffix(".")
        remedy = " ".join(remedy.split())
        return ConformanceCheck(name, title, place, drives, kinds, steps, greets, remedy)

    return make


driving = partial(reading, drives=True)
"""Decorates the steps of a check that arms the amplifier and drives its channels."""


async def greeted(client: JudgeClient) -> Values:
    """Read the identity of an amplifier of this version.

    Raises ContractViolation for another version.
    """
    identity = await client.hello()
    versions, client.reply_words = identity["versions"], {}
    verify(bool(versions >> VERSION & 1), "versions", expected=f"bit {VERSION} set", seen=versions)
    return identity


async def _identified(client: JudgeClient, level: float) -> Subject:
    """Identify the amplifier behind a client; raises ContractViolation if that fails."""
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
    """Run numbered checks on one amplifier; return their results.

    before: results of earlier checks. Once the amplifier cannot be identified or silenced, the
    remaining checks are not run. If this machine or the line is always too slow, a check has no
    verdict. Raises LinkError if the line is lost, CommandError for a level below one step.
    """
    results: list[CheckResult] = []
    began = threads.now()
    why_none = next((each.reason for each in before if each.result is Result.NOT_RUN), "")
    for number, check in checks:
        if (took := threads.now() - began) > _MAX_TIME:
            why_none = why_none or f"the run has used up its time: {took:.0f} s"
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
            # A violation seen while this machine is late counts only if it is seen repeatedly.
            is_doubtful = isinstance(finding, ContractViolation) and client.lag > BUSY
            doubts += is_doubtful
            if not (is_late or (is_doubtful and doubts < FEW)) or why or not client.was_late(since):
                break
    reason = str(finding)
    if is_late:
        attempts = f"in {client.attempts or 1} attempts"
        tried = "because the time for repetitions is used up" if client.is_used_up else attempts
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
    return result, why and f"not run because {check.name} failed"


async def _attempt(
    check: ConformanceCheck, client: JudgeClient, level: float
) -> tuple[CheckOutcome, str]:
    """Run the steps once; return their outcome, and why no further check can run, or ""."""
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
            "unsolicited messages",
            expected="none",
            seen=client.heard[:1],
        )
    except CheckOutcome as found:
        finding = found
    if subject:
        subject.is_at_rest = False
    if isinstance(finding, ContractViolation):
        finding.came = client.came.hex(" ")
        finding.sent = in_words(subject.sent_set) if subject else ""
    is_greeted = check.greets and type(finding) is CheckOutcome
    left = None if is_greeted else await _left(check, client, subject, level)
    finding = left if left and not isinstance(finding, ContractViolation) else finding
    return finding, str(left or "")


async def _carry_out(check: ConformanceCheck, subject: Subject, level: float) -> None:
    """Carry out the steps of a check; a check that drives channels starts at rest."""
    subject.sent_set = []
    if check.drives:
        step = subject.can["level_step"] / FULL
        if level < step:
            raise CommandError(
                f"level must be at least {step:g}, the amplifier's level_step, got {level:g}"
            )
        if not subject.is_at_rest:
            await subject.rest()
    else:
        await subject.watch()
    rows = check.run(subject)
    await (rows if isawaitable(rows) else subject.run(rows))


async def _left(
    check: ConformanceCheck, client: JudgeClient, subject: Subject | None, level: float
) -> CheckOutcome | None:
    """Silence the amplifier, or identify it; return why that failed repeatedly, or None."""
    due = threads.now() + _RETRIED
    while subject is None or check.drives:
        try:
            with suppress(UnusableCapability):  # silent, but cannot be judged
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
    """Return a set in words, then the words of its parts in hexadecimal; empty without parts."""
    if not parts:
        return ""
    try:
        read = [MESSAGES["Set"].request.unpack(each, is_strict=True) for each in parts]
        stream = {each["index"]: each["stream"] for each in read}
        layers = unpack_layers([word for index in sorted(stream) for word in stream[index]])
        now = "played immediately" if read[0]["now"] else "staged"
        meaning = "; ".join([f"set {read[0]['token']}, {now}", *map(_layer, layers)])
    except Refusal as refusal:
        meaning = f"incomplete set: {refusal}"
    return f"{meaning} = {' | '.join(' '.join(f'{word:04X}' for word in each) for each in parts)}"


def _flags(one: LayerSet | Command) -> str:
    """Return the flags and envelopes of a layer or a command."""
    texts = []
    for name in FLAGS:
        value = getattr(one, name, None)
        if isinstance(value, Envelope):
            step = 1e3 * QUANTITIES["envelope_step"].from_wire(value.step)
            texts.append(f" {name} of {len(value.knots)} knots, {step:g} ms apart")
        elif value:
            texts.append(f" {name}")
    return "".join(texts)


def _layer(one: LayerSet) -> str:
    head = f"layer {one.layer}{_flags(one)}, ramp {one.ramp} ms, valid for {one.valid_for} ms"
    return ": ".join([head, *filter(None, [", ".join(map(_tone, one.commands))])])


def _tone(one: Command) -> str:
    tone = [form.format(QUANTITIES[name].from_wire(getattr(one, name))) for name, form in _TONE]
    return f"channel {one.channel} {' '.join(tone)}{_flags(one)}"
