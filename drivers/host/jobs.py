"""Requests that wait for a line, and commits that wait for other lines.

Which one is sent next, and which are superseded. Commits of several lines arrive at one moment,
whatever the speeds of the lines and what keeps them; the remaining skew is that with which the
operating system sends bytes. Times [s] are of the event loop's clock.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple, final

from drivers.errors import CommandRefused, Preempted
from drivers.protocol.records import Values
from drivers.protocol.timing import ATTEMPTS

if TYPE_CHECKING:
    from drivers.host.dialogue import Dialogue

_SLACK = 0.002  # s; timers are up to this late, so the rest of a wait is polled


class _Ready(NamedTuple):
    takes: float
    result: "asyncio.Future[Values]"
    send: Callable[[], None]


@final
class JointStart:
    """Where so many lines wait, each free for its commit; the slowest one sends first.

    until: latest time [s] at which the commits must arrive. Where one cannot send, none does that
    has not sent before.
    """

    def __init__(self, count: int, until: float) -> None:
        self._count, self._until = count, until
        self._ready: list[_Ready] = []
        self._failure: Exception | None = None
        self._arrival = 0.0
        self._looked_at = 0.0
        self._loop = asyncio.get_running_loop()
        self._timer = self._loop.call_at(until, self._give_up)

    def arrive(
        self, takes: float, result: "asyncio.Future[Values]", send: Callable[[], None]
    ) -> None:
        """Note that a line is free for a commit, which takes a time [s] to arrive.

        result: of the commit. send: called once, when it is to be sent, or its result has an error;
        calls `fail` where that does not succeed.
        """
        self._ready.append(_Ready(takes, result, send))
        if self._failure is not None:
            self._keep_back(self._failure)
        elif len(self._ready) == self._count:
            self._ready.sort(key=attrgetter("takes"))
            self._arrival = self._loop.time() + self._ready[-1].takes
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
        """Send none that waits or comes later: each has the first error of them as its result."""
        self._timer.cancel()
        self._failure = self._failure or error
        ready, self._ready = self._ready, []
        for each in ready:
            if not each.result.done():
                each.result.set_exception(self._failure)
                each.result.exception()  # retrieved, where nobody waits for it
            each.send()  # nothing, but its line is held no longer

    def _send_due(self) -> None:
        now = self._loop.time()
        while self._ready and self._arrival - self._ready[-1].takes <= now:
            self._ready.pop().send()
        if not self._ready:
            return
        due = self._arrival - self._ready[-1].takes
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


@dataclass(eq=False, slots=True)
class Job:
    """A request from its queueing to its result; member: None for a broadcast.

    make: values of each attempt, in its turn; raises CommandRefused. parts: values of
    the messages of a request, those without a reply, where there are several: known once `make`
    has returned the first. attempts: left. start: of a commit that goes out together with those of
    other lines, until it was sent: is_held for them, then is_released. started_at [s]: when it went
    out behind what was sent before. longer: than on a fast wire
    its reply may take [s]. delays: of this process, while its reply is awaited. had_no_reply: to an
    earlier attempt.
    """

    member: "Dialogue | None"
    priority: Priority
    name: str
    values: Values
    make: Callable[[], Values] | None
    timeout: float
    queued_at: float
    result: "asyncio.Future[Values]"
    start: JointStart | None = None
    parts: list[Values] | None = None
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

    def is_superseded_by(self, priority: Priority, member: "Dialogue | None") -> bool:
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

    def superseded_by(self, priority: Priority, member: "Dialogue | None") -> list[Job]:
        """Return the jobs that a request for an amplifier, None for all, makes obsolete."""
        return [job for job in self.jobs if job.is_superseded_by(priority, member)]

    def supersedes(self, job: Job) -> bool:
        """Whether one that waits makes a job obsolete."""
        return any(job.is_superseded_by(other.priority, other.member) for other in self.jobs)
