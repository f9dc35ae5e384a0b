"""Requests that wait for a line: which one is sent next, and which others make it obsolete.

Only this module compares requests. It depends on their priority, and on how long they have waited:

    priority          next in the queue    discards from the queue    its reply is awaited
    STOP              first                HEARTBEAT SET ARM CLEAR    until its deadline
    SILENCE           after STOP           SET ARM                    until its deadline
    HEARTBEAT         after SILENCE        nothing                    8 ms if STOP or SILENCE wait
    SET               after HEARTBEAT      nothing                    like HEARTBEAT
    ARM CLEAR OTHER   after SET            nothing                    like HEARTBEAT
    READING           last                 nothing                    see below

SET, ARM, CLEAR and OTHER are as urgent as HEARTBEAT once they have waited for 50 ms. A request
discards only requests to the same amplifier; a broadcast discards requests to all of them.
A READING is given up as soon as the line is free if STOP or SILENCE wait, and once its reply must
have begun if HEARTBEAT or SET wait. Times [s] refer to the event loop's clock.
"""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum, IntEnum, auto
from typing import Protocol, TypeAlias

from drivers.errors import WireCounters
from drivers.protocol.definition import ATTEMPTS, FAST
from drivers.protocol.records import Values
from drivers.wires.wire import DuplicateAddress, Event, OtherHost

MAX_WAIT = 0.05  # s; a request that has waited for longer is sent before newer sets and heartbeats


class Priority(IntEnum):
    """Priority of a request."""

    STOP = 0
    SILENCE = 1
    HEARTBEAT = 2
    SET = 3
    ARM = 4
    CLEAR = 5
    OTHER = 6
    READING = 7


_RANKS = {
    Priority.STOP: 0,
    Priority.SILENCE: 1,
    Priority.HEARTBEAT: 2,
    Priority.SET: 3,
    Priority.ARM: 4,
    Priority.CLEAR: 4,
    Priority.OTHER: 4,
    Priority.READING: 5,
}
"""Order in the queue: the smallest is sent first, and equal ones in the order of queueing."""

_DISCARDED = {
    # A queued heartbeat would feed the watchdog of an amplifier that did not receive the stop.
    Priority.STOP: (Priority.HEARTBEAT, Priority.SET, Priority.ARM, Priority.CLEAR),
    Priority.SILENCE: (Priority.SET, Priority.ARM),
}
"""Priorities of the queued requests that a request makes obsolete."""


class ReplyWait(Enum):
    """How long the reply to a request is awaited while others wait for the line."""

    FULL = auto()
    """Until its deadline."""
    UNTIL_START = auto()
    """Until it must have begun to arrive."""
    SHORT = auto()
    """A few milliseconds."""
    NONE = auto()
    """Not at all: until the line is free."""


Make: TypeAlias = Callable[[], list[Values]]
"""A function that makes a request when its turn comes.

It is called once, and returns the values of each message of the request or raises CommandRefused.
"""


@dataclass
class LinkStatistics(WireCounters):
    """Statistics of a link at one moment.

    The inherited counters restart when the link is opened; those below never do.
    """

    retries: int = 0
    """Number of requests that were repeated."""
    timeouts: int = 0
    """Number of requests that had no reply in time."""
    refusals: int = 0
    """Number of requests that the amplifier refused by a Nak."""
    last_round_trip: float | None = None
    """Time from the last request with a reply to that reply [s]."""


class Member(Protocol):
    """Interface of an amplifier to its line: records requests and replies."""

    name: str
    address: int
    counts: LinkStatistics
    no_reply_cause: str | None
    """Why the amplifier counts as mute, after a request without reply; None if it replies."""

    def request_time(self, name: str, values: Values) -> float:
        """Return how long a request and its reply take on the wire [s]."""

    def check_may_send(self, name: str, values: Values, priority: Priority) -> None:
        """Raise DriverError if a request must not be sent."""

    def note_sent(self, name: str, values: Values, now: float, arrives: float) -> None:
        """Note a request that is sent now and reaches the amplifier at a time [s]."""

    def note_reply(self, name: str, values: Values, reply: Values, sent_at: float) -> None:
        """Note the reply to a request that was sent at a time [s]."""

    def note_unasked(self, arrival: Event | OtherHost | DuplicateAddress) -> None:
        """Note a message that the amplifier sent without a request."""


@dataclass(eq=False, slots=True)
class Job:
    """A request, from the time when it is queued to its result."""

    member: Member | None
    """The amplifier that it is for; None for a broadcast."""
    priority: Priority
    name: str
    timeout: float
    """How long its reply is awaited on a fast wire [s]."""
    queued_at: float
    parts: Sequence[Values] = ()
    """The values of its messages; only the last message has a reply."""
    make: Make | None = None
    """Makes the messages; None once it has been called."""
    check: Callable[[], None] | None = None
    """Called before each message is sent; raises an error if it must not be sent any more."""
    result: "asyncio.Future[Values]" = field(default_factory=asyncio.Future)
    part: int = 0
    """Index of the message that is on the line, or is sent next."""
    reached: int = 0
    """Index of the first message that was missing when the last reply came."""
    attempts: int = ATTEMPTS
    """Remaining number of attempts."""
    is_pausing: bool = False
    """Whether it is not sent yet, because the amplifier was busy."""
    had_no_reply: bool = False
    """Whether an earlier attempt had no reply."""

    @property
    def values(self) -> Values:
        """Values of the message that is on the line, or is sent next; empty until it is made."""
        return self.parts[self.part] if self.parts else {}

    @property
    def has_further_parts(self) -> bool:
        """Whether messages follow the one on the line, which then has no reply."""
        return self.part < len(self.parts) - 1

    @property
    def is_stop_class(self) -> bool:
        """Whether it silences the amplifier, and so is sent and repeated before all others."""
        return self.priority <= Priority.SILENCE

    def make_parts(self) -> None:
        """Make its messages, unless they have been made; raises CommandRefused."""
        if self.make is not None:
            self.parts = self.make()
            self.make = None

    def spend_attempt(self, takes: float) -> None:
        """Count an attempt; takes: duration of request and reply on the wire [s].

        On a slow wire there is one attempt less, so that an amplifier counts as degraded as soon as
        on other wires. A set of several parts keeps its attempts, because each part can be lost;
        heartbeats between the parts detect a mute amplifier.
        """
        is_cut = takes > FAST and self.attempts == ATTEMPTS and len(self.parts) < 2
        self.attempts -= 2 if is_cut else 1

    def go_on(self) -> None:
        """Go on to the next message; the attempt for this one did not fail."""
        self.attempts += 1
        self.part += 1

    def reach(self, part: int) -> None:
        """Note that all parts before this one have arrived; any progress restores all attempts."""
        if part > self.reached:
            self.reached = part
            self.attempts = ATTEMPTS

    def go_back_to_missing(self, reply: Values) -> bool:
        """Go back to the first part that a reply reports as missing; return False without one."""
        missing = reply["missing"]
        if reply["staged"] or reply["played"] or missing >= self.part:
            return False
        self.part = missing
        self.reach(missing)
        return True

    def has_waited(self, now: float) -> bool:
        """Whether it has waited for so long that it is as urgent as a heartbeat; now [s]."""
        is_minor = Priority.HEARTBEAT < self.priority < Priority.READING
        return is_minor and now - self.queued_at > MAX_WAIT

    def is_superseded_by(self, priority: Priority, member: Member | None) -> bool:
        """Whether a request with a priority makes it obsolete; member: None for a broadcast."""
        return self.priority in _DISCARDED.get(priority, ()) and member in (self.member, None)

    def reply_wait(self, queue: Sequence["Job"]) -> ReplyWait:
        """Return how long its reply is awaited while a queue of requests waits."""
        if self.is_stop_class:
            return ReplyWait.FULL
        first = min([queued.priority for queued in queue], default=self.priority)
        is_reading = self.priority is Priority.READING
        if first <= Priority.SILENCE:
            return ReplyWait.NONE if is_reading else ReplyWait.SHORT
        return ReplyWait.UNTIL_START if is_reading and first <= Priority.SET else ReplyWait.FULL


class JobQueue(list[Job]):
    """The requests waiting for a line, in the order of queueing."""

    _had_waited = False  # whether the last job taken had waited for long

    @property
    def has_stop(self) -> bool:
        """Whether a request that silences an amplifier is waiting."""
        return any(job.is_stop_class for job in self)

    def take(self, job: Job, now: float) -> None:
        """Remove the job whose turn it is."""
        self.remove(job)
        self._had_waited = job.has_waited(now)

    def _rank(self, job: Job, now: float) -> tuple[int, int]:
        """Return the rank of a job; now [s].

        One job that has waited for long goes before the heartbeats, the next one after them.
        """
        if job.has_waited(now):
            return _RANKS[Priority.HEARTBEAT], 2 if self._had_waited else 1
        return _RANKS[job.priority], 1

    def has_before(self, job: Job, now: float) -> bool:
        """Whether any waiting job goes before this one; now [s]."""
        first = self.next(now) if self else None
        return first is not None and self._rank(first, now) < self._rank(job, now)

    def next(self, now: float) -> Job | None:
        """Return the next job, or None while all jobs, or a stop, are pausing."""
        first: Job | None = self[0]
        if len(self) > 1:
            ready = [job for job in self if job.is_stop_class or not job.is_pausing]
            first = min(ready, key=lambda job: self._rank(job, now), default=None)
        return None if first is None or first.is_pausing else first

    def superseded_by(self, priority: Priority, member: Member | None) -> list[Job]:
        """Return the jobs that a new request makes obsolete; member: None for a broadcast."""
        return [job for job in self if job.is_superseded_by(priority, member)]

    def supersedes(self, job: Job) -> bool:
        """Whether a waiting request makes a job obsolete."""
        return any(job.is_superseded_by(waiting.priority, waiting.member) for waiting in self)
