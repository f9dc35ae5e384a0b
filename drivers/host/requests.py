"""Requests of a line: which one is sent next, and until when its reply is awaited.

Only this module compares requests. Their order depends on their priority, and on how long they have
waited:

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
have begun if HEARTBEAT or SET wait. This module only decides; `drivers.host.line` sends requests
and ends attempts. Times [s] refer to the event loop's clock; now is the present time.
"""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum, IntEnum, auto
from typing import Protocol, TypeAlias

from drivers.errors import WireCounters
from drivers.protocol.definition import ATTEMPTS, FAST, REACTION
from drivers.protocol.records import Values
from drivers.wires.wire import DuplicateAddress, Event, OtherHost, Wire

MAX_WAIT = 0.05  # s; a request that has waited for longer is sent before newer sets and heartbeats
GRACE = 0.008  # s; how long a stop waits for the reply to another request
_AHEAD = 0.005  # s; lead for writing the next part of a set; a stop waits for bytes already sent
_FULL_PAUSE = 0.0005  # s; before checking a blocked port again
_LATE = 0.005  # s; if a timer fires later than this, this process was delayed
_MAX_LATE = 0.032
"""Maximum extra time [s] to await a reply after late replies.

An adapter can delay data by 16 ms in each direction.
"""
_LATE_DECAY = 0.9  # of the lateness of replies, with each reply
_MAX_COMMIT_LATE = 0.003  # s; one frame of full-speed USB, 1 ms, for each of port, hub and adapter
_SENDING = 0.0005  # s; this process needs it to write to all lines
_DELAYS = 4  # delays of this process that prolong the wait for one reply


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


class AttemptPhase(Enum):
    """What an attempt waits for."""

    NEXT_PART = auto()
    """Until its message has nearly arrived; then the next part of the set follows."""
    CONFIRMED = auto()
    """Nothing: the amplifier has confirmed the part, and the next part follows now."""
    REPLY = auto()
    """The reply, or the next response of a message on Modbus."""
    LAST_LOOK = auto()
    """The reply is due; the port is read once more after the event loop's other work."""


@dataclass(eq=False, slots=True)
class Attempt:
    """The transmission of one message of a request, and the wait for its reply."""

    job: Job
    member: Member
    """The amplifier that it is for."""
    takes: float
    """Duration of request and reply on the wire [s]."""
    sent_at: float
    """When its first bytes were written to the port [s]."""
    started_at: float
    """When its first bit was on the wire [s], after earlier requests."""
    phase: AttemptPhase
    due: float = 0.0
    """Deadline of the reply [s]."""
    delays: int = 0
    """How often this process was delayed while the reply was awaited."""


class ReplyTiming:
    """When a line is free, and until when the reply to an attempt is awaited."""

    def __init__(self) -> None:
        self.late = 0.0
        """Delay of replies [s] beyond the time on the wire, at most `_MAX_LATE`."""
        self._sent_until = 0.0
        """Until when sent bytes are still under way [s]."""
        self._free_at = 0.0
        """Until when a reply may still occupy the line [s]."""

    def begins(self, now: float) -> float:
        """Return when bytes that are written now are on the wire [s]: after earlier ones."""
        return max(now, self._sent_until)

    def commit_arrives(self, now: float, takes: float) -> float:
        """Return when a commit that is sent next arrives at the latest [s]; takes: on the wire."""
        begins = max(now, self._free_at, self._sent_until)
        late = min(self.late, _MAX_COMMIT_LATE) + _SENDING
        return begins + takes + late

    def next_part_due(self, now: float, *, is_blocked: bool) -> float:
        """Return when the next part of a set is written [s]; is_blocked: the port."""
        earliest = now + _FULL_PAUSE if is_blocked else now
        return max(self._sent_until - _AHEAD, earliest)

    def note_written(self, begins: float, wire: Wire) -> None:
        """Note that bytes are written, whose first bit is on the wire at a time [s]."""
        self._sent_until = begins + wire.takes
        self._free_at = begins + wire.busy

    def note_arrived(self) -> None:
        """Note that the bytes that were sent have arrived, since there is a reply."""
        self._sent_until = 0.0

    def note_continuation(self, now: float) -> None:
        """Note the response to the first part of a message on Modbus."""
        self.late = max(self.late, min(now - self._free_at, _MAX_LATE))

    def note_reply(self, attempt: Attempt, now: float) -> None:
        """Note the reply to an attempt."""
        late = now - attempt.started_at - attempt.takes
        self.late = min(max(late, self.late * _LATE_DECAY), _MAX_LATE)

    def set_deadline(self, attempt: Attempt, begins: float) -> None:
        """Set the deadline of the reply to bytes that are on the wire from a time [s] on."""
        # On Modbus each of the two responses may begin late.
        late = self.late if self.late > GRACE else 0.0
        slowness = max(attempt.takes - FAST, 0.0)
        attempt.due = max(attempt.due, begins + slowness + attempt.job.timeout + late)
        attempt.delays = 0

    def shorten(self, attempt: Attempt, wait: ReplyWait, now: float) -> None:
        """Set an earlier deadline, because other requests wait for the line."""
        free_at = max(now, self._free_at)
        match wait:
            case ReplyWait.NONE:
                attempt.due = min(attempt.due, free_at)
            case ReplyWait.SHORT:
                attempt.due = min(attempt.due, free_at + GRACE)
            # Where replies come late, a reading that is cut short each time would never end.
            case ReplyWait.UNTIL_START if self.late <= GRACE:
                begins_by = max(attempt.started_at + attempt.takes, self._free_at) + REACTION
                attempt.due = min(attempt.due, max(now, begins_by))

    def prolong(self, attempt: Attempt, timer_due: float, now: float, *, must_yield: bool) -> None:
        """Set a later deadline if the timer, due at a time [s], has fired late.

        This process was delayed by as much. The reply keeps the time that it had left when the
        delay began, unless it must yield to a stop.
        """
        delayed_since = max(timer_due, attempt.sent_at)
        if now - delayed_since > _LATE and attempt.delays < _DELAYS:
            attempt.delays += 1
            left = 0.0 if must_yield else attempt.due - delayed_since
            attempt.due = now + max(left, _LATE)
