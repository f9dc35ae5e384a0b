"""Requests that wait for a line, and commits that wait for other lines.

Which one is sent next, and which are superseded. Commits of several lines arrive at one moment,
whatever the speeds of the lines and what keeps them; the remaining skew is that with which the
operating system sends bytes. Times [s] are of the event loop's clock.
"""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from operator import itemgetter
from typing import Protocol, TypeAlias, final

from drivers.counters import LinkStatistics
from drivers.errors import CommandRefused, Preempted
from drivers.protocol.records import Values
from drivers.protocol.timing import ATTEMPTS
from drivers.wires.wire import Event, OtherHost, Several

_SLACK = 0.002  # s; timers are up to this late, so the rest of a wait is polled

Release: TypeAlias = Callable[[Exception | None], None]
"""Sends a commit that was held, or fails it with an error."""


@final
class JointStart:
    """Where so many lines wait, each free for its commit; the slowest one sends first.

    until: latest time [s] at which the commits must arrive. Where one cannot send, none does that
    has not sent before.
    """

    def __init__(self, count: int, until: float) -> None:
        self._count, self._until = count, until
        self._ready: list[tuple[float, Release]] = []  # how long each takes to arrive
        self._failure: Exception | None = None
        self._arrival = 0.0
        self._looked_at = 0.0
        self._loop = asyncio.get_running_loop()
        self._timer = self._loop.call_at(until, self._give_up)

    def arrive(self, takes: float, release: Release) -> None:
        """Note that a line is free for a commit, which takes a time [s] to arrive.

        release: called once; calls `fail` where that does not succeed.
        """
        self._ready.append((takes, release))
        if self._failure is not None:
            self._keep_back(self._failure)
        elif len(self._ready) == self._count:
            self._ready.sort(key=itemgetter(0))
            self._arrival = self._loop.time() + self._ready[-1][0]
            if self._arrival > self._until:
                self._give_up()
                return
            self._timer.cancel()
            self._loop.call_soon(self._send_due)  # none behind the pump of the line that came last

    def fail(self, error: Exception) -> None:
        """Note that one will not be sent: those that were not sent yet are not sent either."""
        self._keep_back(Preempted(f"one of several commits failed: {error}"))

    def _give_up(self) -> None:
        text = "commits must be sent together; one of the lines is too busy"
        self._keep_back(CommandRefused(text, until=self._loop.time()))

    def _keep_back(self, error: Exception) -> None:
        """Send none that waits or comes later: each fails with the first error of them."""
        self._timer.cancel()
        self._failure = self._failure or error
        ready, self._ready = self._ready, []
        for _, release in ready:
            release(self._failure)

    def _send_due(self) -> None:
        now = self._loop.time()
        while self._ready and self._arrival - self._ready[-1][0] <= now:
            self._ready.pop()[1](None)
        if not self._ready:
            return
        due = self._arrival - self._ready[-1][0]
        if now == self._looked_at or due - now > 2 * _SLACK:  # virtual time: its timers are exact
            self._loop.call_at(due if now == self._looked_at else due - _SLACK, self._send_due)
        else:
            self._loop.call_soon(self._send_due)
        self._looked_at = now


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


class Member(Protocol):
    """An amplifier on a line, which notes what is sent to it and what comes from it."""

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

    values: of the message on the line, or next. make: until its turn has come; parts: what it made
    that has no reply yet. attempts: left. start: of a commit that goes out together
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
    make: Make | None = None
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
