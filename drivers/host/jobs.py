"""Requests that wait for a line: which one is sent next, and which are superseded.

Times [s] are of the event loop's clock.
"""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Protocol

from drivers.host.joint_start import JointStart
from drivers.host.timing import ATTEMPTS
from drivers.host.wire import Event, OtherHost, Several
from drivers.protocol.records import Values
from drivers.statistics import LinkStatistics

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


_SUPERSEDED = {
    # A queued heartbeat would feed the watchdog of an amplifier that did not receive the stop.
    Priority.STOP: (Priority.HEARTBEAT, Priority.SET, Priority.ARM, Priority.CLEAR),
    Priority.SILENCE: (Priority.SET, Priority.ARM),
}


class Later(NamedTuple):
    """What a request says, known once its turn has come.

    make: returns the values of its messages, for each attempt until the first one has a reply;
    raises CommandRefused. start: where it goes out together with commits of other lines.
    """

    make: Callable[[], list[Values]]
    start: JointStart | None = None


class Member(Protocol):
    """An amplifier on a line, which is told of what is sent to it and what comes from it."""

    name: str
    address: int
    counts: LinkStatistics
    silence_cause: str | None
    """Why it counts as mute: it did not reply to a request."""

    def exchange_time(self, name: str) -> float:
        """Return how long the longest request of a name and its reply take on the wire [s]."""

    def next_request(self, name: str, values: Values, priority: Priority) -> float:
        """Return how much later its reply may come [s]; raises where it must not go out."""

    def note_sent(self, name: str, values: Values, now: float, arrives: float) -> None:
        """Note a request that is sent now and arrives at a time [s]."""

    def note_reply(self, name: str, values: Values, reply: Values, sent_at: float) -> None:
        """Note the reply to a request that was sent at a time [s]."""

    def note_unasked(self, arrival: Event | OtherHost | Several) -> None:
        """Note what came without a request."""


@dataclass(eq=False, slots=True)
class Job:
    """A request from its queueing to its result; member: None for a broadcast.

    values: of the message on the line, or next. later: makes the messages until the first of them
    has a reply; parts: those without one. attempts: left. start: of a commit that goes out together
    with those of other lines, until it was sent: is_held for them, then is_released. started_at
    [s]: when it went out behind what was sent before. longer: than on a fast wire its reply may
    take [s]. delays: of this process, while its reply is awaited. had_no_reply: to an earlier
    attempt.
    """

    member: Member | None
    priority: Priority
    name: str
    values: Values
    timeout: float
    queued_at: float
    result: "asyncio.Future[Values]"
    later: Later | None = None
    start: JointStart | None = None
    parts: Sequence[Values] = ()
    attempts: int = ATTEMPTS
    is_held: bool = False
    is_released: bool = False
    not_before: float = 0.0
    sent_at: float = 0.0
    started_at: float = 0.0
    due: float = 0.0
    longer: float = 0.0
    delays: int = 0
    is_last_look: bool = False
    had_no_reply: bool = False

    @property
    def is_stop_class(self) -> bool:
        """Whether it silences the amplifier: sent and repeated before all others."""
        return self.priority <= Priority.SILENCE

    def has_waited(self, now: float) -> bool:
        """Whether it is as urgent as a heartbeat by now [s], for it waits for long."""
        is_minor = Priority.HEARTBEAT < self.priority < Priority.READING
        return is_minor and now - self.queued_at > MAX_WAIT

    def is_superseded_by(self, priority: Priority, member: Member | None) -> bool:
        """Whether a request for an amplifier, None for all, makes it obsolete."""
        return self.priority in _SUPERSEDED.get(priority, ()) and member in (self.member, None)


class JobQueue:
    """Jobs that wait for one line."""

    def __init__(self) -> None:
        self.jobs: list[Job] = []
        """In the order in which they were queued, as those of one rank are sent."""
        self.add = self.jobs.append
        self._had_waited = False  # the last one that was taken

    def remove(self, job: Job) -> None:
        """Take a job out, if it waits."""
        if job in self.jobs:
            self.jobs.remove(job)

    def take(self, job: Job, now: float) -> None:
        """Take the one out whose turn it is."""
        self.jobs.remove(job)
        self._had_waited = job.has_waited(now)

    def _rank(self, job: Job, now: float) -> tuple[int, int]:
        """Place at a time [s]: a commit held for other lines goes before heartbeats and sets.

        Of those that have waited for long one goes before a heartbeat that waits, not several.
        """
        if job.is_held and job.priority > Priority.HEARTBEAT:
            return Priority.HEARTBEAT, 0
        if job.has_waited(now):
            return Priority.HEARTBEAT, 2 if self._had_waited else 1
        is_reading = job.priority is Priority.READING
        return job.priority if is_reading else min(job.priority, Priority.ARM), 1

    def next(self, now: float) -> Job | None:
        """Return the job whose turn it is; None while all pause, or a stop does."""
        first: Job | None = self.jobs[0]
        if len(self.jobs) > 1:
            ready = [job for job in self.jobs if job.not_before <= now or job.is_stop_class]
            first = min(ready, key=lambda job: self._rank(job, now), default=None)
        return None if first is None or first.not_before > now else first
