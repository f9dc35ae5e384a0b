"""The operation of the plate: states, events, and `step`, which applies the transition table.

States have the names of CiA 402.

- Only ARM in READY_TO_SWITCH_ON leads to SWITCHED_ON, and only ARMED from there to
  OPERATION_ENABLED.
- QUICK_STOP_ACTIVE and FAULT lead only to SWITCH_ON_DISABLED, by VERIFIED: all amplifiers have been
  read back, without a fault and at level zero, after a CLEAR of the same epoch (`find_problem`).
- COMM_LOST ends with RECONNECTED, once the watchdog of every lost amplifier has certainly expired;
  it leads to FAULT if anything was latched or energised before.
- An event without an entry in the table changes nothing.

Observers are called after the actions of a transition have begun (`DeferredCalls`).
"""

import asyncio
import logging
import math
import re
import secrets
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, StrEnum, auto
from typing import NamedTuple, Self

from drivers.host.amplifier import Amplifier
from drivers.protocol.definition import FAULTS, STATES, name_of
from drivers.protocol.records import Values

_REMEDIES = {
    "WATCHDOG": "end programs that take the processor, or check the wire: it received nothing in "
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
    named = (_REMEDIES[name] for name in re.findall("[A-Z_]+", cause) if name in _REMEDIES)
    return f"{next(named, 'find the cause')}, then clear (era clear) and arm again"


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
    STOP = auto()  # requested
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
        """Return it for its duration from now [s] on."""
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
        is_armed = self.state is DaemonState.OPERATION_ENABLED and self.lease is not None
        return is_armed and self.lease_at(now) is None


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
    **_from(DaemonState, Trigger.STOP, None, Action.STOP),
    **_from((*_SILENT, *ENERGISED), Trigger.STOP, DaemonState.QUICK_STOP_ACTIVE, Action.STOP),
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


def failed(operation: Operation, cause: str) -> Operation:
    """Return the operation after an unexpected exception: latched, and in FAULT if open."""
    epoch = operation.epoch + 1
    if operation.state in (DaemonState.NOT_READY, DaemonState.COMM_LOST):
        return replace(operation, is_latched=True, epoch=epoch)
    return Operation(DaemonState.FAULT, cause, fault_remedy(cause), is_latched=True, epoch=epoch)


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
    is_back = to in (DaemonState.FAULT, DaemonState.SWITCH_ON_DISABLED)
    if before.lost is not None and is_back:
        cause = f"all amplifiers reply again and are disarmed; before: {before.lost.cause}"
    is_fault = to in (DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT)
    remedy = fault_remedy(cause) if is_fault else event.remedy
    if to is before.state:
        # A persisting fault may have a new cause.
        is_new_cause = event.trigger in (Trigger.FAULT, Trigger.LINK_CHANGED) and bool(event.cause)
        return replace(updated, cause=cause, remedy=remedy) if is_new_cause else updated
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


_DELAY = 0.001  # s; the actions of a transition have begun by then
_MAX_PENDING = 256

_logger = logging.getLogger(__name__)


class DeferredCalls:
    """Calls callbacks in order, one per iteration of the event loop.

    An exception in a callback is logged and does not affect others. Above 256 pending calls, the
    oldest are dropped.
    """

    def __init__(self) -> None:
        self._pending: deque[Callable[[], object]] = deque(maxlen=_MAX_PENDING)
        self._handle: asyncio.Handle | None = None

    def add(self, callback: Callable[[], object]) -> None:
        """Call back a moment later."""
        self._pending.append(callback)
        if self._handle is None:
            self._handle = asyncio.get_running_loop().call_later(_DELAY, self._call_next)

    def flush(self) -> None:
        """Make all pending calls now."""
        while self._pending:
            call_guarded(self._pending.popleft())
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None

    def _call_next(self) -> None:
        callback, self._handle = self._pending.popleft(), None
        if self._pending:
            self._handle = asyncio.get_running_loop().call_soon(self._call_next)
        call_guarded(callback)


def call_guarded(callback: Callable[[], object]) -> None:
    """Call an observer; log its exception instead of raising it."""
    try:
        callback()
    except Exception:
        _logger.exception("observer failed")


READ_BACK_INTERVAL = 0.02  # s

_ENABLED = STATES["OPERATION_ENABLED"]
_DISARMED = STATES["SWITCH_ON_DISABLED"]


def are_silent(statuses: Mapping[str, Values], amplifiers: Mapping[str, Amplifier]) -> bool:
    """Whether all amplifiers report that they are disarmed and silent."""
    return not is_any_armed(statuses) and all(
        amplifiers[name].is_silent(status) for name, status in statuses.items()
    )


def is_any_armed(statuses: Mapping[str, Values]) -> bool:
    """Whether an amplifier reports that it is armed."""
    return any(each["state"] == _ENABLED for each in statuses.values())


def find_problem(statuses: Mapping[str, Values], amplifiers: Mapping[str, Amplifier]) -> str | None:
    """Describe the first amplifier that is armed, in a fault or not silent; None without one."""
    for name, status in statuses.items():
        if status["state"] != _DISARMED or status["fault"]:
            fault = f", fault {name_of(FAULTS, status['fault'])}" if status["fault"] else ""
            return f"amplifier {name} is in {name_of(STATES, status['state'])}{fault}"
        if not amplifiers[name].is_silent(status):
            return (
                f"amplifier {name}: levels of all channels must be 0 while it is disarmed, got "
                f"{status['levels']}"
            )
    return None
