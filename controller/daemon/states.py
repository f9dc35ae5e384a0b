"""What state the daemon is in, and what may follow: a table, and `step`, which goes by it.

The names are those of CiA 402. In words:

- Nothing but ARM, in READY_TO_SWITCH_ON, leads to SWITCHED_ON, and from there ARMED to
  OPERATION_ENABLED.
- QUICK_STOP_ACTIVE and FAULT are left for SWITCH_ON_DISABLED only, and only once somebody has
  acknowledged (CLEAR) and all amplifiers have then been read back as sound: no fault, level zero.
- COMM_LOST is left once the amplifiers are open again *and* the time has passed for which a lost
  one may go on playing; for FAULT, if anything was latched or energised before.
- What the table does not name leaves everything as it is.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum, StrEnum, auto
from typing import NamedTuple

from drivers.amplifier import WATCHDOG

ACKNOWLEDGE = "find the cause, then clear (era clear) and arm again"
"""What somebody has to do about a fault."""

_MARGIN = 0.1  # s; beyond the watchdog, for the clocks and the last ramp


class State(StrEnum):
    """States by their CiA 402 names, and COMM_LOST."""

    NOT_READY = "NOT_READY"
    SWITCH_ON_DISABLED = "SWITCH_ON_DISABLED"
    READY_TO_SWITCH_ON = "READY_TO_SWITCH_ON"
    SWITCHED_ON = "SWITCHED_ON"
    OPERATION_ENABLED = "OPERATION_ENABLED"
    QUICK_STOP_ACTIVE = "QUICK_STOP_ACTIVE"
    FAULT_REACTION_ACTIVE = "FAULT_REACTION_ACTIVE"
    FAULT = "FAULT"
    COMM_LOST = "COMM_LOST"


class Kind(Enum):
    """What can happen."""

    OPENED = auto()  # every amplifier answered and is the expected one
    SOUND = auto()  # every amplifier was read back: disarmed, no fault, level zero
    ARM = auto()  # somebody asks for it
    ARMED = auto()  # every amplifier confirmed it
    DISARM = auto()  # somebody asks for it
    LEASE_LOST = auto()  # whoever armed has not renewed
    STOP = auto()  # somebody asks for it
    CLEAR = auto()  # somebody acknowledges
    FAULT = auto()  # an amplifier or the loop reports one
    REACTED = auto()  # what a fault asks for was done
    LINK_LOST = auto()  # an amplifier cannot be reached
    REOPENED = auto()  # after that: all answer again, and are disarmed
    TICK = auto()  # time passes
    CLOSE = auto()  # the daemon ends


class Action(Enum):
    """What is to be done; what comes of it is the next event."""

    VERIFY = auto()  # disarm what still plays, read all back: SOUND or FAULT
    ARM = auto()  # ARMED or FAULT
    DISARM = auto()
    STOP = auto()  # quick stop of all that can be reached
    REACT = auto()  # quick stop, then REACTED
    CLEAR = auto()  # acknowledge at the amplifiers, read all back: SOUND or FAULT
    RECONNECT = auto()  # with growing pauses: REOPENED
    CLOSE = auto()  # silent along a ramp, read back, disarmed, closed


@dataclass(frozen=True)
class Event:
    """Something that happened: why, and what one can do about it."""

    kind: Kind
    cause: str = ""
    remedy: str | None = None


@dataclass(frozen=True)
class Machine:
    """The daemon's state and all that its next step depends on.

    latched: somebody must acknowledge before anything is armed; acknowledged: somebody has, and the
    amplifiers are being read back; lost_at [s]: when the link was lost; reopened: since then.
    """

    state: State = State.NOT_READY
    cause: str = "the daemon starts"
    remedy: str | None = None
    latched: bool = False
    acknowledged: bool = False
    lost_at: float = 0.0
    reopened: bool = False

    def lost_for(self, now: float) -> float | None:
        """How long [s] a link has been lost at a time [s]; None where none is."""
        return now - self.lost_at if self.state is State.COMM_LOST else None

    def assume_energised(self, now: float) -> bool:
        """Whether amplifiers that cannot be reached may still be playing at a time [s]."""
        lost_for = self.lost_for(now)
        return lost_for is not None and lost_for < WATCHDOG + _MARGIN


class Rule(NamedTuple):
    """Where an event leads to, what is to be done, and when the rule holds."""

    to: State
    actions: tuple[Action, ...] = ()
    when: Callable[[Machine, float], bool] = lambda machine, now: True


_SILENT = (State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON)
_ENERGISED = (State.SWITCHED_ON, State.OPERATION_ENABLED)
_LATCHING = (State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE, State.FAULT)
_OPEN = (*_SILENT, *_ENERGISED, *_LATCHING)


def _acknowledged(machine: Machine, now: float) -> bool:
    return machine.acknowledged


def _safe_to_go_on(machine: Machine, now: float) -> bool:
    return machine.reopened and not machine.assume_energised(now)


def _safe_but_latched(machine: Machine, now: float) -> bool:
    return machine.latched and _safe_to_go_on(machine, now)


_BACK = (
    Rule(State.FAULT, when=_safe_but_latched),
    Rule(State.SWITCH_ON_DISABLED, (Action.VERIFY,), _safe_to_go_on),
    Rule(State.COMM_LOST),
)

TABLE: Mapping[tuple[State, Kind], tuple[Rule, ...]] = {
    (State.NOT_READY, Kind.OPENED): (Rule(State.SWITCH_ON_DISABLED, (Action.VERIFY,)),),
    (State.SWITCH_ON_DISABLED, Kind.SOUND): (Rule(State.READY_TO_SWITCH_ON),),
    (State.READY_TO_SWITCH_ON, Kind.ARM): (Rule(State.SWITCHED_ON, (Action.ARM,)),),
    (State.SWITCHED_ON, Kind.ARMED): (Rule(State.OPERATION_ENABLED),),
    **{
        (state, kind): (Rule(State.SWITCH_ON_DISABLED, (Action.DISARM, Action.VERIFY)),)
        for state in _ENERGISED
        for kind in (Kind.DISARM, Kind.LEASE_LOST)
    },
    **{
        (state, Kind.STOP): (Rule(State.QUICK_STOP_ACTIVE, (Action.STOP,)),)
        for state in (*_SILENT, *_ENERGISED, State.QUICK_STOP_ACTIVE)
    },
    **{
        (state, Kind.STOP): (Rule(state, (Action.STOP,)),)
        for state in (State.FAULT_REACTION_ACTIVE, State.FAULT, State.COMM_LOST)
    },
    **{
        (state, Kind.FAULT): (Rule(State.FAULT_REACTION_ACTIVE, (Action.REACT,)),)
        for state in (*_SILENT, *_ENERGISED, State.QUICK_STOP_ACTIVE)
    },
    (State.FAULT, Kind.FAULT): (Rule(State.FAULT),),
    (State.FAULT_REACTION_ACTIVE, Kind.REACTED): (Rule(State.FAULT),),
    **{
        (state, Kind.CLEAR): (Rule(state, (Action.CLEAR,)),)
        for state in (State.QUICK_STOP_ACTIVE, State.FAULT)
    },
    **{
        (state, Kind.SOUND): (Rule(State.SWITCH_ON_DISABLED, (Action.VERIFY,), _acknowledged),)
        for state in (State.QUICK_STOP_ACTIVE, State.FAULT)
    },
    **{
        (state, Kind.LINK_LOST): (Rule(State.COMM_LOST, (Action.STOP, Action.RECONNECT)),)
        for state in _OPEN
    },
    (State.COMM_LOST, Kind.LINK_LOST): (
        Rule(State.COMM_LOST, (Action.RECONNECT,), lambda machine, now: machine.reopened),
    ),
    (State.COMM_LOST, Kind.REOPENED): _BACK,
    (State.COMM_LOST, Kind.TICK): _BACK,
    **{(state, Kind.CLOSE): (Rule(State.NOT_READY, (Action.CLOSE,)),) for state in State},
}
"""Rules by state and event, the first that holds counts; whatever is not here changes nothing."""


def step(machine: Machine, event: Event, now: float) -> tuple[Machine, tuple[Action, ...]]:
    """What follows from an event at a time [s], and what is to be done then."""
    after = _noted(machine, event, now)
    for rule in TABLE.get((machine.state, event.kind), ()):
        if rule.when(after, now):
            return _entered(machine, after, rule.to, event), rule.actions
    return machine, ()


def _noted(machine: Machine, event: Event, now: float) -> Machine:
    """The machine with what an event alone says, whatever state follows."""
    match event.kind:
        case Kind.CLEAR:
            return replace(machine, acknowledged=True)
        case Kind.FAULT:
            return replace(machine, acknowledged=False)
        case Kind.STOP:
            return replace(machine, acknowledged=False, latched=True)
        case Kind.LINK_LOST if machine.state is not State.COMM_LOST:
            latched = machine.latched or machine.state in _ENERGISED
            return replace(
                machine, lost_at=now, reopened=False, latched=latched, acknowledged=False
            )
        case Kind.REOPENED:
            return replace(machine, reopened=True)
        case _:
            return machine


def _entered(before: Machine, after: Machine, to: State, event: Event) -> Machine:
    """The machine in the state that a rule leads to."""
    if event.kind is Kind.LINK_LOST:
        after = replace(after, reopened=False)
    if to is before.state:
        # A fault that is still there may have another reason by now.
        told = event.kind is Kind.FAULT and bool(event.cause)
        return replace(after, cause=event.cause, remedy=event.remedy) if told else after
    latched = to in _LATCHING or (to is State.COMM_LOST and after.latched)
    # Back on a link, what it was lost for is still the reason, but no longer how it is.
    cause, remedy = event.cause or before.cause, event.remedy
    if before.state is State.COMM_LOST and to in (State.FAULT, State.SWITCH_ON_DISABLED):
        cause = f"all amplifiers answer again, and are disarmed; before that: {cause}"
        remedy = ACKNOWLEDGE if to is State.FAULT else None
    return replace(after, state=to, cause=cause, remedy=remedy, latched=latched, acknowledged=False)
