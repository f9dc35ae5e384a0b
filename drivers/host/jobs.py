"""Requests that wait for a line: which one is sent next, and which are superseded.

Times [s] are of the event loop's clock.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from drivers.host.joint_start import JointStart
from drivers.protocol.records import Values

MAX_WAIT = 0.05  # s; after which a request goes before newer sets and heartbeats


class Priority(IntEnum):
    """Priority of a request: the smaller is sent first."""

    STOP = 0
    SILENCE = 1
    HEARTBEAT = 2
    SET = 3
    ARM = 4
    CLEAR = 5
    OTHER = 6
    READING = 7

    @property
    def is_stop_class(self) -> bool:
        """Whether it silences the amplifier: sent and repeated before all others."""
        return self <= Priority.SILENCE


_SUPERSEDED = {
    # A queued heartbeat would feed the watchdog of an amplifier that did not receive the stop.
    Priority.STOP: (Priority.HEARTBEAT, Priority.SET, Priority.ARM, Priority.CLEAR),
    Priority.SILENCE: (Priority.SET, Priority.ARM),
}


@dataclass
class RequestCounts:
    """Counts of an amplifier: repeated requests, those without a reply in time, refused ones."""

    retries: int = 0
    timeouts: int = 0
    refusals: int = 0


class Member(Protocol):
    """An amplifier as its line sees it."""

    @property
    def address(self) -> int:
        """Its address."""

    @property
    def counts(self) -> RequestCounts:
        """Counts of its requests."""

    def overtime(self, name: str, values: Values) -> float:
        """Return how much later than on a fast wire the reply to a request may come [s]."""

    def note_sent(self, name: str, values: Values, now: float) -> None:
        """Note a request that may have reached it."""

    def note_reply(self, name: str, values: Values, reply: Values, sent_at: float) -> None:
        """Note the reply to a request sent at a time [s]; raises CommandRefused for its caller."""

    def note_refusal(self) -> None:
        """Note that it has replied, with a refusal or what cannot be read."""

    def note_silence(self, cause: str) -> None:
        """Note that it has not replied to all attempts of a request."""

    def note_event(self, values: Values) -> None:
        """Note what it told unasked."""

    def note_other_host(self) -> None:
        """Note that another host drives it."""

    def note_several(self) -> None:
        """Note that a second amplifier has replied at its address."""

    def check_request(self, name: str) -> None:
        """Raise LinkError where a request of this name must not go out now."""


@dataclass(eq=False, slots=True)
class Job:
    """A request from its queueing to its result; member: None for a broadcast.

    make: values of each attempt, in its turn; raises CommandRefused. attempts: left. start: of a
    commit that goes out together with those of other lines. had_no_reply: to an earlier attempt.
    """

    member: Member | None
    priority: Priority
    name: str
    values: Values
    make: Callable[[], Values] | None
    attempts: int
    timeout: float
    queued_at: float
    result: "asyncio.Future[Values]"
    start: JointStart | None = None
    is_held: bool = False
    number: int = 0
    not_before: float = 0.0
    sent_at: float = 0.0
    due: float = 0.0
    looks: int = 0
    had_no_reply: bool = False

    def rank(self, now: float) -> tuple[int, bool, int]:
        """Place in the queue at a time [s]; one that is held for other lines goes before sets."""
        rank: int = self.priority
        if rank != Priority.READING:
            rank = min(rank, Priority.ARM)
            if rank > Priority.HEARTBEAT and (self.is_held or now - self.queued_at > MAX_WAIT):
                rank = Priority.HEARTBEAT
        return rank, not self.is_held, self.number


class JobQueue:
    """Jobs that wait for one line."""

    def __init__(self) -> None:
        self.jobs: list[Job] = []
        """In the order in which they were queued."""
        self._number = 0

    def add(self, job: Job) -> None:
        """Queue a job, behind those of its priority."""
        self._number += 1
        job.number = self._number
        self.jobs.append(job)

    def remove(self, job: Job) -> None:
        """Take a job out, if it waits."""
        if job in self.jobs:
            self.jobs.remove(job)

    def next(self, now: float) -> Job | None:
        """Return the job whose turn it is; None while all pause, or a stop does."""
        if len(self.jobs) == 1:
            (first,) = self.jobs
        else:
            first = min(self.jobs, key=lambda job: job.rank(now))
            if first.not_before > now and not first.priority.is_stop_class:
                ready = [job for job in self.jobs if job.not_before <= now]
                return min(ready, key=lambda job: job.rank(now), default=None)
        return first if first.not_before <= now else None

    def superseded_by(self, priority: Priority, member: Member | None) -> list[Job]:
        """Return the jobs that a request for an amplifier, None for all, makes obsolete."""
        obsolete = _SUPERSEDED.get(priority, ())
        return [
            job for job in self.jobs if job.priority in obsolete and member in (job.member, None)
        ]

    def supersedes(self, job: Job) -> bool:
        """Whether one that waits makes a job obsolete."""
        return any(
            other.member in (job.member, None)
            and job.priority in _SUPERSEDED.get(other.priority, ())
            for other in self.jobs
        )

    @property
    def next_due(self) -> float:
        """When the first of those that pause is due [s]; 0 if none pauses."""
        return min((job.not_before for job in self.jobs if job.not_before), default=0.0)
