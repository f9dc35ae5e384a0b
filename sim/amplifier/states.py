"""State table: which request is allowed in which state, and the state that follows.

Any other request is refused (WRONG_STATE). Transitions without a request are in the amplifier:
OPERATION_ENABLED to FAULT_REACTION_ACTIVE when the watchdog expires, from there to FAULT once
silent; SWITCHED_ON, entered by Disarm, to SWITCH_ON_DISABLED once silent. Clear needs silence.
"""

from collections.abc import Mapping
from typing import TypeAlias

from drivers.protocol.messages import (
    AmplifierState,
    Apply,
    Arm,
    Clear,
    Commit,
    Disarm,
    GetBlock,
    GetCaps,
    GetFaults,
    GetMeasured,
    GetReading,
    GetSensors,
    GetStatus,
    Hello,
    LoadEnvelope,
    Measure,
    Ping,
    Request,
    SetAddress,
    Stage,
    Stop,
)

ENABLED = frozenset({AmplifierState.OPERATION_ENABLED})
"""States in which the amplifier may play and its watchdog runs."""

Table: TypeAlias = Mapping[tuple[AmplifierState, type[Request]], AmplifierState]

_ASKING: tuple[type[Request], ...] = (
    *(Hello, GetCaps, GetStatus, GetFaults, GetMeasured, Ping, LoadEnvelope),
    *(GetSensors, Measure, GetReading, GetBlock),
)
_PLAYING: tuple[type[Request], ...] = (Stage, Commit, Apply)
_OFF = (AmplifierState.SWITCH_ON_DISABLED, AmplifierState.READY_TO_SWITCH_ON)
_STOPPED = (
    AmplifierState.QUICK_STOP_ACTIVE,
    AmplifierState.FAULT_REACTION_ACTIVE,
    AmplifierState.FAULT,
)

TRANSITIONS: Table = {
    **{(state, request): state for state in AmplifierState for request in _ASKING},
    # Silencing is allowed in every state, and never clears a latched stop or fault.
    **{(state, Disarm): state for state in (AmplifierState.NOT_READY, *_OFF, *_STOPPED)},
    (AmplifierState.SWITCHED_ON, Disarm): AmplifierState.SWITCHED_ON,
    (AmplifierState.OPERATION_ENABLED, Disarm): AmplifierState.SWITCHED_ON,
    **{(state, Stop): AmplifierState.QUICK_STOP_ACTIVE for state in AmplifierState},
    **{
        (state, Stop): state
        for state in (
            AmplifierState.NOT_READY,
            AmplifierState.FAULT_REACTION_ACTIVE,
            AmplifierState.FAULT,
        )
    },
    **{(state, SetAddress): state for state in _OFF},
    **{(state, Clear): state for state in AmplifierState},
    (AmplifierState.QUICK_STOP_ACTIVE, Clear): AmplifierState.SWITCH_ON_DISABLED,
    (AmplifierState.FAULT, Clear): AmplifierState.SWITCH_ON_DISABLED,
    # READY_TO_SWITCH_ON and SWITCHED_ON are passed through at once: Arm goes all the way.
    **{
        (state, Arm): AmplifierState.OPERATION_ENABLED
        for state in (*_OFF, AmplifierState.SWITCHED_ON)
    },
    (AmplifierState.OPERATION_ENABLED, Arm): AmplifierState.OPERATION_ENABLED,
    **{
        (AmplifierState.OPERATION_ENABLED, request): AmplifierState.OPERATION_ENABLED
        for request in _PLAYING
    },
}


def next_state(state: AmplifierState, request: type[Request]) -> AmplifierState | None:
    """The state after a request, or None where it is refused."""
    return TRANSITIONS.get((state, request))
