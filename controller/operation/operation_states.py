"""The operation of the plate: states, events, and `step`, which applies the transition table.

States have the names of CiA 402.

- Only ARM in READY_TO_SWITCH_ON leads to SWITCHED_ON, and only ARMED from there to
  OPERATION_ENABLED.
- QUICK_STOP_ACTIVE and FAULT lead only to SWITCH_ON_DISABLED, by VERIFIED: all amplifiers have been
  read back, without a fault and at level zero, after a CLEAR of the same epoch (`find_problem`).
- COMM_LOST ends with RECONNECTED, once the watchdog of every lost amplifier has certainly expired;
  it leads to FAULT if anything was latched or energized before.
- An event without an entry in the table changes nothing.

Observers are called after the actions of a transition have begun (`deferred_calls`).
"""

import math
import re
import secrets
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import Enum, StrEnum, auto
from typing import NamedTuple, Self

_REMEDIES = {
    "WATCHDOG": "stop programs that load the processor, or check the wire: no request arrived in "
    "time",
    "OVER_TEMPERATURE": "let it cool, check its ventilation",
    "OVER_VOLTAGE": "check its supply",
    "ARC": "switch it off, then look for moisture and damaged insulation at ERAs and cables",
    "CHANNEL": "check the ERA and the cable of the channel",
    "INTERNAL": "switch it off and on, see its manual",
    "INTERLOCK": "close its interlock",
    "OVER_CURRENT": "check ERAs and cables for a short circuit",
}
"""Remedies of the faults that an amplifier reports."""


def fault_remedy(cause: str) -> str:
    """Return the remedy of a fault, by the names of faults in its cause."""
    remedy = "find the cause"
    for word in re.findall("[A-Z_]+", cause):
        if word in _REMEDIES:
            remedy = _REMEDIES[word]
            break
    return f"{remedy}, then clear (era clear) and arm again"


class DaemonState(StrEnum):
    """State of the daemon: the states of CiA 402, and COMM_LOST."""

    NOT_READY = "NOT_READY"
    SWITCH_ON_DISABLED = "SWITCH_ON_DISABLED"
    READY_TO_SWITCH_ON = "READY_TO_SWITCH_ON"
    SWITCHED_ON = "SWITCHED_ON"
    OPERATION_ENABLED = "OPERATION_ENABLED"
    QUICK_STOP_ACTIVE = "QUICK_STOP_ACTIVE"
    FAULT_REACTION_ACTIVE = "FAULT_REACTION_ACTIVE"
    FAULT = "FAULT"
    COMM_LOST = "COMM_LOST"


_NEXT_STEPS = {
    DaemonState.SWITCH_ON_DISABLED: "wait a moment and try again",
    DaemonState.READY_TO_SWITCH_ON: "arm first (era arm)",
}


class Trigger(Enum):
    """Kinds of events."""

    OPENED = auto()  # every amplifier has replied with the expected identity
    NOT_FOUND = auto()  # an amplifier cannot be reached at the start
    VERIFIED = auto()  # every amplifier was read back: disarmed, no fault, level zero
    ARM = auto()  # requested
    ARMED = auto()  # every amplifier has confirmed
    DISARM = auto()  # requested, or the arming lease was not renewed
    STOP = auto()  # requested; the amplifiers are being stopped already
    CLEAR = auto()  # acknowledgement requested
    FAULT = auto()  # reported by an amplifier or the control loop
    REACTION_DONE = auto()  # the fault reaction is complete
    LINK_LOST = auto()  # an amplifier cannot be reached
    LINK_CHANGED = auto()  # an amplifier does not reply but may still play, or all reply again
    RECONNECTED = auto()  # all amplifiers reply again and are disarmed, and the lost ones silent
    CLOSE = auto()  # the daemon shuts down


class Action(Enum):
    """Actions of a transition; the outcome of each is the next event."""

    VERIFY = auto()  # disarm what still plays, read all back: VERIFIED or FAULT
    ARM = auto()  # ARMED or FAULT
    DISARM = auto()
    STOP = auto()  # quick stop of all amplifiers, lost ones included
    REACT = auto()  # quick stop, then REACTION_DONE
    CLEAR = auto()  # acknowledge at the amplifiers, read all back: VERIFIED or FAULT
    RECONNECT = auto()  # with growing pauses: RECONNECTED
    CLOSE = auto()  # ramp down, read back, disarm, close


@dataclass(frozen=True)
class Lease:
    """The lease of the client that armed: without renewal the amplifiers are disarmed."""

    owner: str
    duration: float
    """Time [s] from each renewal to the end."""
    token: str = field(default_factory=lambda: secrets.token_hex(16))
    """Proof of ownership."""
    expires_at: float = math.inf
    """[s]"""

    def renewed(self, now: float) -> Self:
        """Return the lease, renewed for its duration from now [s] on."""
        return replace(self, expires_at=now + self.duration)


@dataclass(frozen=True)
class DaemonEvent:
    """An event with its cause."""

    trigger: Trigger
    cause: str = ""
    remedy: str | None = None
    """For the user; the remedy of a fault follows from its cause instead."""
    lease: Lease | None = None
    amplifiers: tuple[str, ...] = ()
    """Names of the amplifiers that are lost or do not reply."""


class Loss(NamedTuple):
    """A loss of amplifiers, after which all others were closed."""

    at: float
    """[s]"""
    cause: str
    names: tuple[str, ...] = ()
    """Empty if it is not known which amplifiers are lost."""


@dataclass(frozen=True)
class Operation:
    """The state of the plate and everything that the next transition depends on."""

    state: DaemonState = DaemonState.NOT_READY
    cause: str = "the daemon is starting"
    remedy: str | None = None
    is_latched: bool = False
    """Whether a clear is required before arming."""
    lost: Loss | None = None
    """Set while amplifiers cannot be reached."""
    degraded: tuple[str, ...] = ()
    """Names of armed amplifiers that do not reply but may still play, as reported last."""
    lease: Lease | None = None
    """Of the client that armed; in the states of `ENERGISED` alone."""
    epoch: int = 0
    """Rises with every change of state, and with a stop, fault or loss that changes none: actions
    that began in an earlier epoch must not go on."""

    @property
    def next_step(self) -> str | None:
        """What to do before anything can play: the remedy, or the next step of the state."""
        return self.remedy or _NEXT_STEPS.get(self.state)

    def lease_at(self, now: float) -> Lease | None:
        """Return the lease, or None if it has expired at a time [s]."""
        return self.lease if self.lease is not None and now < self.lease.expires_at else None

    def is_lease_over(self, now: float) -> bool:
        """Whether amplifiers are armed for a client whose lease has expired at a time [s]."""
        if self.state is not DaemonState.OPERATION_ENABLED or self.lease is None:
            return False
        return self.lease_at(now) is None


class Transition(NamedTuple):
    """The next state, and the actions on the way there."""

    to: DaemonState
    actions: tuple[Action, ...] = ()


_SILENT = (DaemonState.SWITCH_ON_DISABLED, DaemonState.READY_TO_SWITCH_ON)
ENERGISED = (DaemonState.SWITCHED_ON, DaemonState.OPERATION_ENABLED)
"""States in which amplifiers have or get high voltage."""
_OVERTAKING = {
    Trigger.STOP,
    Trigger.DISARM,
    Trigger.FAULT,
    Trigger.LINK_LOST,
    Trigger.CLOSE,
}
"""Events that begin an epoch: what began before them must not go on."""
_LATCHING = (DaemonState.QUICK_STOP_ACTIVE, DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT)
_CLEARABLE = (DaemonState.QUICK_STOP_ACTIVE, DaemonState.FAULT)


def _from(
    states: Iterable[DaemonState], trigger: Trigger, to: DaemonState | None, *actions: Action
) -> dict[tuple[DaemonState, Trigger], Transition]:
    """Return a transition from each of several states; to: None for the same state."""
    return {(state, trigger): Transition(to or state, actions) for state in states}


TRANSITIONS: dict[tuple[DaemonState, Trigger], Transition] = {
    **_from([DaemonState.NOT_READY], Trigger.OPENED, DaemonState.SWITCH_ON_DISABLED, Action.VERIFY),
    **_from([DaemonState.NOT_READY], Trigger.NOT_FOUND, DaemonState.COMM_LOST, Action.RECONNECT),
    **_from([DaemonState.SWITCH_ON_DISABLED], Trigger.VERIFIED, DaemonState.READY_TO_SWITCH_ON),
    **_from([DaemonState.READY_TO_SWITCH_ON], Trigger.ARM, DaemonState.SWITCHED_ON, Action.ARM),
    **_from([DaemonState.SWITCHED_ON], Trigger.ARMED, DaemonState.OPERATION_ENABLED),
    **_from(
        ENERGISED,
        Trigger.DISARM,
        DaemonState.SWITCH_ON_DISABLED,
        Action.DISARM,
        Action.VERIFY,
    ),
    # `Supervisor.stop` queues the stop before this event.
    **_from(DaemonState, Trigger.STOP, None),
    **_from((*_SILENT, *ENERGISED), Trigger.STOP, DaemonState.QUICK_STOP_ACTIVE),
    **_from(
        (*_SILENT, *ENERGISED, DaemonState.QUICK_STOP_ACTIVE),
        Trigger.FAULT,
        DaemonState.FAULT_REACTION_ACTIVE,
        Action.REACT,
    ),
    **_from([DaemonState.FAULT], Trigger.FAULT, None, Action.STOP),
    **_from([DaemonState.FAULT_REACTION_ACTIVE], Trigger.REACTION_DONE, DaemonState.FAULT),
    **_from(_CLEARABLE, Trigger.CLEAR, None, Action.CLEAR),
    **_from(_CLEARABLE, Trigger.VERIFIED, DaemonState.SWITCH_ON_DISABLED, Action.VERIFY),
    **_from(
        (*_SILENT, *ENERGISED, *_LATCHING),
        Trigger.LINK_LOST,
        DaemonState.COMM_LOST,
        Action.STOP,
        Action.RECONNECT,
    ),
    # Read back as silent; a stop would latch an amplifier that returns immediately.
    **_from(
        [DaemonState.READY_TO_SWITCH_ON, DaemonState.COMM_LOST],
        Trigger.LINK_LOST,
        DaemonState.COMM_LOST,
        Action.RECONNECT,
    ),
    **_from([DaemonState.OPERATION_ENABLED], Trigger.LINK_CHANGED, None),
    **_from(
        [DaemonState.COMM_LOST], Trigger.RECONNECTED, DaemonState.SWITCH_ON_DISABLED, Action.VERIFY
    ),
    **_from(DaemonState, Trigger.CLOSE, DaemonState.NOT_READY, Action.CLOSE),
}
"""Transitions by state and trigger; a later row replaces an earlier one."""

_WHEN_LATCHED = TRANSITIONS | {
    **_from([DaemonState.NOT_READY], Trigger.OPENED, DaemonState.QUICK_STOP_ACTIVE, Action.STOP),
    **_from([DaemonState.COMM_LOST], Trigger.RECONNECTED, DaemonState.FAULT),
}
"""The same where a clear is required before arming."""


def step(
    operation: Operation, event: DaemonEvent, now: float
) -> tuple[Operation, tuple[Action, ...]]:
    """Apply an event at a time [s]; return the new operation and the actions to carry out."""
    updated = _with_event(operation, event, now)
    table = _WHEN_LATCHED if updated.is_latched else TRANSITIONS
    transition = table.get((operation.state, event.trigger))
    if transition is None:
        return operation, ()
    return _enter(operation, updated, transition.to, event), transition.actions


def after_exception(operation: Operation, cause: str) -> Operation:
    """Return the operation after an unexpected exception: latched, and in FAULT if open."""
    epoch = operation.epoch + 1
    if operation.state in (DaemonState.NOT_READY, DaemonState.COMM_LOST):
        return replace(operation, is_latched=True, epoch=epoch)
    return Operation(DaemonState.FAULT, cause, fault_remedy(cause), is_latched=True, epoch=epoch)


def not_reopened(
    operation: Operation, error: Exception, remedy: str, names: tuple[str, ...]
) -> Operation:
    """Return the operation after lost amplifiers could not be reopened; names: of those, if known.

    The cause of the loss itself is kept.
    """
    if operation.lost is None:
        return operation
    lost = operation.lost._replace(names=names or operation.lost.names)
    return replace(operation, cause=str(error), remedy=remedy, lost=lost)


def _with_event(operation: Operation, event: DaemonEvent, now: float) -> Operation:
    """Update what an event sets regardless of the next state."""
    if event.trigger in _OVERTAKING:
        operation = replace(operation, epoch=operation.epoch + 1)
    match event.trigger:
        case Trigger.ARM if event.lease is not None:
            return replace(operation, lease=event.lease.renewed(now))
        case Trigger.ARMED if operation.lease is not None:  # arming may have taken longer than it
            return replace(operation, lease=operation.lease.renewed(now))
        case Trigger.STOP:
            return replace(operation, is_latched=True)
        case Trigger.NOT_FOUND | Trigger.LINK_LOST if operation.lost is None:
            is_latched = operation.is_latched or operation.state in ENERGISED
            lost = Loss(now, event.cause, event.amplifiers)
            return replace(operation, lost=lost, is_latched=is_latched)
        case Trigger.LINK_CHANGED:
            return replace(operation, degraded=event.amplifiers)
        case _:
            return operation


def _enter(before: Operation, updated: Operation, to: DaemonState, event: DaemonEvent) -> Operation:
    """Enter the next state of a transition with its cause and remedy."""
    cause = event.cause or before.cause
    if before.lost is not None and to in (DaemonState.FAULT, DaemonState.SWITCH_ON_DISABLED):
        cause = f"all amplifiers reply again and are disarmed; before: {before.lost.cause}"
    remedy = event.remedy
    if to in (DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT):
        remedy = fault_remedy(cause)
    if to is before.state:
        # A persisting fault may have a new cause.
        has_new_cause = event.trigger in (Trigger.FAULT, Trigger.LINK_CHANGED) and event.cause
        return replace(updated, cause=cause, remedy=remedy) if has_new_cause else updated
    is_latched = to in _LATCHING or (to is DaemonState.COMM_LOST and updated.is_latched)
    return replace(
        updated,
        state=to,
        epoch=before.epoch + 1,
        cause=cause,
        remedy=remedy,
        is_latched=is_latched,
        lost=updated.lost if to is DaemonState.COMM_LOST else None,
        degraded=(),
        lease=updated.lease if to in ENERGISED else None,
    )
