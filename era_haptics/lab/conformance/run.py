"""A run of checks on one amplifier: each check from rest, repeated if this machine was late."""

from contextlib import suppress
from inspect import isawaitable
from typing import NamedTuple

from drivers.errors import CommandError
from drivers.protocol.definition import MESSAGES, VERSION
from drivers.protocol.records import Values
from era_haptics.lab.conformance.capabilities import STATED, Capabilities
from era_haptics.lab.conformance.check import ConformanceCheck
from era_haptics.lab.conformance.conformance_report import CheckResult, Result
from era_haptics.lab.conformance.judge_client import JudgeClient
from era_haptics.lab.conformance.lateness import FEW
from era_haptics.lab.conformance.outcomes import (
    AlreadyArmed,
    CheckOutcome,
    ContractViolation,
    LateReply,
    NotApplicable,
    TooLate,
    UntimedClock,
    UnusableCapability,
    read_as,
    verify,
)
from era_haptics.lab.conformance.request_rows import FULL
from era_haptics.lab.conformance.set_text import set_text
from era_haptics.lab.conformance.subject import Subject
from registry import threads

_MAX_TIME = 180.0  # s; a run starts no further check after this time
_RETRY_TIME = 2.0  # s; for repeated attempts to silence or identify the amplifier
_RESULTS = {
    CheckOutcome: Result.PASSED,
    NotApplicable: Result.SKIPPED,
    TooLate: Result.SKIPPED,
    UnusableCapability: Result.NOT_RUN,
}
"""Results by outcome; any other outcome is a failure."""
_DRIVING_OBSTACLES: dict[type[CheckOutcome], str] = {
    AlreadyArmed: "the amplifier is already armed, perhaps by another host",
    UntimedClock: "the amplifier's clock does not advance with time; timing checks depend on it",
}
"""Outcomes after which no check may drive the amplifier, with the reason."""


class CheckAttempt(NamedTuple):
    """Outcome of an attempt at a check, and why no further check can run, or ""."""

    outcome: CheckOutcome
    obstacle: str


def _without_verdict(attempt: CheckAttempt) -> CheckAttempt:
    """Return an attempt whose violation was seen too seldom to count."""
    return attempt._replace(outcome=TooLate(f"unconfirmed violation: {attempt.outcome}"))


async def greeted(client: JudgeClient) -> Values:
    """Read the identity of an amplifier of this version.

    Raises ContractViolation for another version.
    """
    identity = await client.hello()
    client.reply_words = {}
    versions = identity["versions"]
    is_supported = bool(versions >> VERSION & 1)
    verify(is_supported, "versions", expected=f"bit {VERSION} set", actual=versions)
    return identity


class ConformanceRun:
    """Run of checks on the amplifier behind a client.

    level: highest level of driven channels, relative to full level. Once the amplifier cannot be
    identified or silenced, the remaining checks are not run.
    """

    def __init__(self, client: JudgeClient, level: float) -> None:
        self._client = client
        self._level = level
        self._subject: Subject | None = None  # until it is identified
        self._seconds = 0.0  # used by all checks
        self._obstacle = ""  # why no further check can run
        self._driving_obstacle = ""  # why no further check may drive the amplifier

    async def check(self, number: int, check: ConformanceCheck) -> CheckResult:
        """Run a check and return its result; without a verdict if this machine is always late.

        Raises LinkError if the line is lost, CommandError for a level below one step.
        """
        obstacle = self._obstacle_of(check)
        if obstacle:
            return CheckResult(check, number, Result.NOT_RUN, obstacle)
        started_at = threads.now()
        with self._client.lateness.measured():
            attempt = await self._last_attempt(check)
        seconds = threads.now() - started_at
        self._seconds += seconds
        self._note_obstacles(check, attempt)
        outcome = attempt.outcome
        return CheckResult(
            check,
            number,
            _RESULTS.get(type(outcome), Result.FAILED),
            self._reason_of(attempt),
            outcome,
            seconds=seconds,
            attempts=self._client.lateness.attempts + (not isinstance(outcome, TooLate)),
        )

    def _obstacle_of(self, check: ConformanceCheck) -> str:
        """Return why a check cannot run, or ""."""
        if self._seconds > _MAX_TIME and not self._obstacle:
            self._obstacle = f"the run has used up its time: {self._seconds:.0f} s"
        if check.drives and self._driving_obstacle:
            return self._driving_obstacle
        return self._obstacle

    def _note_obstacles(self, check: ConformanceCheck, attempt: CheckAttempt) -> None:
        """Record why further checks cannot run after the last attempt at a check."""
        if attempt.obstacle:
            self._obstacle = f"not run because {check.name} failed"
        if not self._driving_obstacle:
            self._driving_obstacle = _DRIVING_OBSTACLES.get(type(attempt.outcome), "")

    def _reason_of(self, attempt: CheckAttempt) -> str:
        reason = str(attempt.outcome)
        if isinstance(attempt.outcome, TooLate):
            lateness = self._client.lateness
            tries = f"in {lateness.attempts or 1} attempts"
            if lateness.is_used_up:
                tries = "because the time for repetitions is used up"
            reason = f"no verdict {tries}: {reason}; {lateness.cause}"
        if attempt.obstacle and attempt.obstacle != reason:
            reason = f"{reason}; then {attempt.obstacle}"
        return reason

    # Attempts

    async def _last_attempt(self, check: ConformanceCheck) -> CheckAttempt:
        """Attempt a check until this machine was in time; return the last attempt."""
        lateness = self._client.lateness
        doubtful_violations = 0
        while True:
            started_at = threads.now()
            lateness.start_attempt()
            attempt = await self._attempt(check)
            is_late = isinstance(attempt.outcome, TooLate)
            # A violation seen while something is late counts only if it is seen repeatedly; a late
            # reply never does while this machine is late itself.
            is_violation = isinstance(attempt.outcome, ContractViolation)
            is_doubtful = is_violation and lateness.is_disturbing
            doubtful_violations += is_doubtful
            is_delayed = isinstance(attempt.outcome, LateReply) and lateness.is_machine_late
            is_seldom_seen = doubtful_violations < FEW or is_delayed
            is_unconfirmed = is_doubtful and is_seldom_seen and not lateness.slow_reply
            if attempt.obstacle or not (is_late or is_unconfirmed):
                return attempt
            if not lateness.repeats(started_at):
                return _without_verdict(attempt) if is_unconfirmed else attempt

    async def _attempt(self, check: ConformanceCheck) -> CheckAttempt:
        """Run the steps of a check once, then bring the amplifier to rest."""
        client = self._client
        client.inbox.clear()
        outcome = CheckOutcome()
        try:
            if check.greets:
                await check.steps(client)  # type: ignore[misc]
            else:
                await self._carry_out(check, await self._identified())
            is_quiet = not client.inbox
            unsolicited = client.inbox[:1]
            verify(is_quiet, "unsolicited messages", expected="none", actual=unsolicited)
        except CheckOutcome as raised:
            outcome = raised
        is_violation = isinstance(outcome, ContractViolation)
        if is_violation:
            outcome.last_bytes = client.last_bytes.hex(" ")
        if self._subject is not None:
            self._subject.is_at_rest = False
            if is_violation and not check.greets:
                outcome.last_set = set_text(self._subject.sets.sent)
        if check.greets and type(outcome) is CheckOutcome:
            return CheckAttempt(outcome, "")
        failure = await self._leave(check)
        if failure is None:
            return CheckAttempt(outcome, "")
        return CheckAttempt(outcome if is_violation else failure, str(failure))

    async def _carry_out(self, check: ConformanceCheck, subject: Subject) -> None:
        """Carry out the steps of a check; a check that drives channels starts at rest."""
        subject.sets.sent = []
        if not check.drives:
            await subject.watch()
        else:
            self._require_level(subject)
            if not subject.is_at_rest:
                await subject.rest()
        steps = check.steps(subject)
        await (steps if isawaitable(steps) else subject.run(steps))

    def _require_level(self, subject: Subject) -> None:
        step = subject.can["level_step"] / FULL
        if self._level < step:
            raise CommandError(
                f"level must be at least {step:g}, the amplifier's level_step, got {self._level:g}"
            )

    async def _leave(self, check: ConformanceCheck) -> CheckOutcome | None:
        """Silence or identify the amplifier; return why that failed repeatedly, or None."""
        due = threads.now() + _RETRY_TIME
        while self._subject is None or check.drives:
            try:
                with suppress(UnusableCapability):  # silent, but cannot be judged
                    if self._subject is not None:
                        await self._subject.rest()
                    elif check.greets:
                        await greeted(self._client)
                    else:
                        await self._identified()
                return None
            except (ContractViolation, TooLate) as failure:
                if threads.now() > due + self._client.lateness.lag:
                    return failure
        return None

    async def _identified(self) -> Subject:
        """Identify the amplifier, once; raises ContractViolation if that fails."""
        if self._subject is None:
            identity = await greeted(self._client)
            reply = await self._client.exchange(MESSAGES["GetCaps"].number, ())
            verify(not reply.code, "GetCaps", expected="carried out", actual=reply.code)
            stated = read_as("reply to GetCaps", STATED.unpack, reply.words, is_strict=False)
            self._subject = Subject(self._client, identity, Capabilities(stated), self._level)
        return self._subject
