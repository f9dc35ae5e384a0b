"""State table: which request is allowed in which state, and the state that follows.

Any other request is refused (WRONG_STATE). Transitions without a request are in the amplifier:
OPERATION_ENABLED to FAULT_REACTION_ACTIVE when the watchdog expires, from there to FAULT once
silent; SWITCHED_ON, entered by Disarm, to SWITCH_ON_DISABLED once silent. Clear needs silence.
READY_TO_SWITCH_ON and SWITCHED_ON are passed through at once: Arm goes all the way.
"""

from collections.abc import Mapping

from drivers.protocol.definition import MESSAGES, STATES

_OFF = ("SWITCH_ON_DISABLED", "READY_TO_SWITCH_ON")
_KEPT_BY_STOP = ("NOT_READY", "FAULT_REACTION_ACTIVE", "FAULT")
_PLAYING = ("Set", "Commit", "Silence")
_CHANGING = (*_PLAYING, "Arm", "Disarm", "Stop", "Clear", "SetAddress")

TRANSITIONS: Mapping[tuple[str, str], str] = {
    **{(state, name): state for state in STATES for name in MESSAGES if name not in _CHANGING},
    **{("OPERATION_ENABLED", name): "OPERATION_ENABLED" for name in _PLAYING},
    **{
        (state, "Arm"): "OPERATION_ENABLED" for state in (*_OFF, "SWITCHED_ON", "OPERATION_ENABLED")
    },
    # Silencing is allowed in every state, and never clears a latched stop or fault.
    **{(state, "Disarm"): state for state in STATES},
    ("OPERATION_ENABLED", "Disarm"): "SWITCHED_ON",
    **{(state, "Stop"): "QUICK_STOP_ACTIVE" for state in STATES if state not in _KEPT_BY_STOP},
    **{(state, "Stop"): state for state in _KEPT_BY_STOP},
    **{(state, "Clear"): state for state in STATES},
    ("QUICK_STOP_ACTIVE", "Clear"): "SWITCH_ON_DISABLED",
    ("FAULT", "Clear"): "SWITCH_ON_DISABLED",
    **{(state, "SetAddress"): state for state in _OFF},
}
"""The state after a request, by state and name of the request."""
