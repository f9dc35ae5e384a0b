"""Which request is taken in which state, and which state it leads to: a table.

A request that is not in the table for a state is refused (WRONG_STATE). What happens by itself,
the watchdog and the end of a ramp, is the amplifier's own: OPERATION_ENABLED goes to
FAULT_REACTION_ACTIVE when the watchdog runs out and from there to FAULT once silent; SWITCHED_ON,
entered by Disarm, goes to SWITCH_ON_DISABLED once silent. Clear takes effect once silent.
"""

from collections.abc import Mapping
from typing import TypeAlias

from drivers.protocol.messages import (
    Apply,
    Arm,
    Clear,
    Commit,
    Disarm,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    LoadEnvelope,
    Ping,
    Request,
    Stage,
    State,
    Stop,
)

ENABLED = frozenset({State.OPERATION_ENABLED})
"""States in which the amplifier may play and its watchdog runs."""

Table: TypeAlias = Mapping[tuple[State, type[Request]], State]

_ASKING: tuple[type[Request], ...] = (Hello, GetCaps, GetStatus, GetFaults, Ping, LoadEnvelope)
_PLAYING: tuple[type[Request], ...] = (Stage, Commit, Apply)
_OFF = (State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON)
_STOPPED = (State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE, State.FAULT)

TRANSITIONS: Table = {
    **{(state, request): state for state in State for request in _ASKING},
    # Whatever the state, a wish for silence is granted and never undoes a latched stop or fault.
    **{(state, Disarm): state for state in (State.NOT_READY, *_OFF, *_STOPPED)},
    (State.SWITCHED_ON, Disarm): State.SWITCHED_ON,
    (State.OPERATION_ENABLED, Disarm): State.SWITCHED_ON,
    **{(state, Stop): State.QUICK_STOP_ACTIVE for state in State},
    **{
        (state, Stop): state
        for state in (State.NOT_READY, State.FAULT_REACTION_ACTIVE, State.FAULT)
    },
    **{(state, Clear): state for state in State},
    (State.QUICK_STOP_ACTIVE, Clear): State.SWITCH_ON_DISABLED,
    (State.FAULT, Clear): State.SWITCH_ON_DISABLED,
    # READY_TO_SWITCH_ON and SWITCHED_ON are passed through at once: Arm goes all the way.
    **{(state, Arm): State.OPERATION_ENABLED for state in (*_OFF, State.SWITCHED_ON)},
    (State.OPERATION_ENABLED, Arm): State.OPERATION_ENABLED,
    **{(State.OPERATION_ENABLED, request): State.OPERATION_ENABLED for request in _PLAYING},
}


def next_state(state: State, request: type[Request]) -> State | None:
    """The state that a request leads to, or None where it is refused."""
    return TRANSITIONS.get((state, request))
