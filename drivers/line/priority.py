"""Priorities of requests on one line: which is sent first, and which makes others obsolete."""

from enum import IntEnum
from typing import final

from drivers.protocol.messages import (
    Apply,
    Arm,
    Clear,
    Commit,
    Disarm,
    GetBlock,
    GetReading,
    GetSensors,
    Measure,
    Ping,
    Request,
    Stage,
    Stop,
)

# s; how long a stop-class request waits for the reply to another one: most replies arrive
# within it, and with a ramp of 10 ms all channels are silent within 20 ms.
PREEMPTION_GRACE = 0.008


@final
class Priority(IntEnum):
    """Priority of a request; the smaller `rank` is sent first."""

    STOP = 0
    SILENCE = 1  # disarm, or a silent set
    HEARTBEAT = 2
    APPLY = 3  # or a part of it: stage, commit
    ARM = 4
    CLEAR = 5
    OTHER = 6
    READING = 7  # of sensors: nothing that is felt or that keeps safe waits for it

    @property
    def rank(self) -> int:
        """Place in the queue; equal ranks are sent in their order."""
        return self if self is Priority.READING else min(self, Priority.ARM)

    @property
    def gains_rank(self) -> bool:
        """Whether it goes before newer heartbeats and sets once it has waited for long."""
        return self is not Priority.READING

    @property
    def is_stop_class(self) -> bool:
        """Whether it silences the amplifier: sent and retried before all others."""
        return self <= Priority.SILENCE

    def preempts(self, other: "Priority") -> bool:
        """Whether it abandons a request of that priority on the line.

        A set disturbs the reading that is on the line, which is then worth nothing.
        """
        is_disturbing = self is Priority.APPLY and other is Priority.READING
        return is_disturbing or (self.is_stop_class and self < other)

    def supersedes(self, other: "Priority") -> bool:
        """Whether this request makes a queued one of that priority obsolete."""
        return other in _SUPERSEDED.get(self, ())


_SUPERSEDED = {
    # A queued heartbeat would feed the watchdog of an amplifier that did not receive the stop.
    Priority.STOP: (Priority.HEARTBEAT, Priority.APPLY, Priority.ARM, Priority.CLEAR),
    Priority.SILENCE: (Priority.APPLY, Priority.ARM),
    Priority.APPLY: (Priority.APPLY,),
}

_BY_TYPE: dict[type[Request], Priority] = {
    Stop: Priority.STOP,
    Disarm: Priority.SILENCE,
    Ping: Priority.HEARTBEAT,
    Apply: Priority.APPLY,
    Stage: Priority.APPLY,
    Commit: Priority.APPLY,
    Arm: Priority.ARM,
    Clear: Priority.CLEAR,
    GetSensors: Priority.READING,
    Measure: Priority.READING,
    GetReading: Priority.READING,
    GetBlock: Priority.READING,
}


def priority_of(request: Request) -> Priority:
    """Return the priority of a request."""
    if isinstance(request, Apply) and request.command_set.is_silent:
        return Priority.SILENCE
    return _BY_TYPE.get(type(request), Priority.OTHER)
