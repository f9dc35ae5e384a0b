"""Requests that wait for a line, and commits that wait for other lines.

Which one is sent next, and which are superseded. Commits of several lines arrive at one moment,
whatever the speeds of the lines and what keeps them; the remaining skew is that with which the
operating system sends bytes. Times [s] are of the event loop's clock.
"""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol, TypeAlias

from drivers.errors import WireCounters
from drivers.protocol.definition import ATTEMPTS
from drivers.protocol.records import Values
from drivers.wires.wire import Event, OtherHost, Several

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


Make: TypeAlias = Callable[[], list[Values]]
"""What a request says, known once its turn has come.

Called once, then; returns the values of its messages, or raises CommandRefused.
"""


@dataclass
class LinkStatistics(WireCounters):
    """Statistics of a link at one moment.

    Inherited counters restart when the link is opened, the following count since its construction.
    retries: repeated requests; timeouts: requests without a reply in time; refusals: Naks.
    last_round_trip [s].
    """

    retries: int = 0
    timeouts: int = 0
    refusals: int = 0
    last_round_trip: float | None = None


class Member(Protocol):
    """An amplifier on a line, which notes what is sent to it and what comes from it."""

    name: str
    address: int
    counts: LinkStatistics
    silence_cause: str | None
    """Why it counts as mute: it did not reply to a request."""

    def next_request(self, name: str, values: Values, priority: Priority) -> float:
        """Return how long it and its reply take on the wire [s]; raises if it must not go out."""

    def note_sent(self, name: str, values: Values, now: float, arrives: float) -> None:
        """Note a request that is sent now and arrives at a time [s]."""

    def note_reply(self, name: str, values: Values, reply: Values, sent_at: float) -> None:
        """Note the reply to a request that was sent at a time [s]."""

    def note_unasked(self, arrival: Event | OtherHost | Several) -> None:
        """Note what came without a request."""


@dataclass(eq=False, slots=True)
class Job:
    """A request from its queueing to its result; member: None for a broadcast.

    values: of the message on the line, or next. make: until its turn has come; parts: the messages
    that it made, the last of which is replied to; part: number of the one on the line, or next.
    reached: the first part that was missing when the last reply came. attempts: left. started_at
    [s]: when it went out behind what was sent before. takes: on the wire with its reply [s].
    delays: of this process, while its reply is awaited. had_no_reply: to an earlier attempt.
    """

    member: Member | None
    priority: Priority
    name: str
    values: Values
    timeout: float
    queued_at: float
    make: Make | None = None
    result: "asyncio.Future[Values]" = field(default_factory=asyncio.Future)
    parts: Sequence[Values] = ()
    part: int = 0
    reached: int = 0
    attempts: int = ATTEMPTS
    is_pausing: bool = False
    sent_at: float = 0.0
    started_at: float = 0.0
    due: float = 0.0
    takes: float = 0.0
    delays: int = 0
    is_last_look: bool = False
    had_no_reply: bool = False

    @property
    def has_further_parts(self) -> bool:
        """Whether the message on the line is no last part, and so has no reply."""
        return self.part < len(self.parts) - 1

    def reach(self, part: int) -> None:
        """Note that all before a part have arrived: one that is farther than ever begins anew."""
        if part > self.reached:
            self.reached, self.attempts = part, ATTEMPTS

    def is_missing(self, taken: Values) -> bool:
        """Go back to the first part that a reply to the last says is missing; False if none is."""
        missing = taken["missing"]
        if taken["staged"] or taken["played"] or missing >= self.part:
            return False
        self.part, self.values = missing, self.parts[missing]
        self.reach(missing)
        return True

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
        """Place at a time [s]: of those that have waited for long one before a heartbeat."""
        if job.has_waited(now):
            return Priority.HEARTBEAT, 2 if self._had_waited else 1
        is_reading = job.priority is Priority.READING
        return job.priority if is_reading else min(job.priority, Priority.ARM), 1

    def has_before(self, job: Job, now: float) -> bool:
        """Whether a job that waits goes before another one at a time [s]."""
        first = self.next(now) if self.jobs else None
        return first is not None and self._rank(first, now) < self._rank(job, now)

    def next(self, now: float) -> Job | None:
        """Return the job whose turn it is; None while all pause, or a stop does."""
        first: Job | None = self.jobs[0]
        if len(self.jobs) > 1:
            ready = [job for job in self.jobs if job.is_stop_class or not job.is_pausing]
            first = min(ready, key=lambda job: self._rank(job, now), default=None)
        return None if first is None or first.is_pausing else first
