"""An attempt to transmit a message on a line, and until when its reply is awaited.

`ReplyTiming` only decides: `drivers.host.line` sends, and ends attempts. Times [s] refer to the
event loop's clock; now is the present time.
"""

from dataclasses import dataclass
from enum import Enum, auto

from drivers.host.requests import Job, Member, ReplyWait
from drivers.protocol.definition import FAST, REACTION
from drivers.wires.wire import Wire

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
