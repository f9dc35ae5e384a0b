"""The states of a daemon against a table written by hand."""

from collections.abc import Sequence

import pytest

from controller.operation.operation_states import (
    Action,
    DaemonEvent,
    DaemonState,
    Operation,
    Trigger,
    after_exception,
    fault_remedy,
    step,
)
from drivers.protocol.definition import FAULTS

# The whole table by hand, from the states and the fault table of the wire protocol: the next state
# (= for the same) and the actions in order. A dot: nothing changes. RECONNECTED and LINK_CHANGED
# have tests of their own.
TABLE = """
OPENED NOT_FOUND VERIFIED ARM ARMED DISARM STOP CLEAR FAULT REACTION_DONE LINK_LOST CLOSE
NOT_READY             SD:v CL:n .    .    .   .     =:   .   .    .   .     NR:x
SWITCH_ON_DISABLED    .    .    RS:  .    .   .     QS:  .   FR:r .   CL:sn NR:x
READY_TO_SWITCH_ON    .    .    .    SO:a .   .     QS:  .   FR:r .   CL:n  NR:x
SWITCHED_ON           .    .    .    .    OE: SD:dv QS:  .   FR:r .   CL:sn NR:x
OPERATION_ENABLED     .    .    .    .    .   SD:dv QS:  .   FR:r .   CL:sn NR:x
QUICK_STOP_ACTIVE     .    .    SD:v .    .   .     =:   =:c FR:r .   CL:sn NR:x
FAULT_REACTION_ACTIVE .    .    .    .    .   .     =:   .   .    FA: CL:sn NR:x
FAULT                 .    .    SD:v .    .   .     =:   =:c =:s  .   CL:sn NR:x
COMM_LOST             .    .    .    .    .   .     =:   .   .    .   =:n   NR:x
"""
STATE_CODES = {
    "NR": "NOT_READY",
    "SD": "SWITCH_ON_DISABLED",
    "RS": "READY_TO_SWITCH_ON",
    "SO": "SWITCHED_ON",
    "OE": "OPERATION_ENABLED",
    "QS": "QUICK_STOP_ACTIVE",
    "FR": "FAULT_REACTION_ACTIVE",
    "FA": "FAULT",
    "CL": "COMM_LOST",
}
ACTION_CODES = {
    "v": "VERIFY",
    "a": "ARM",
    "d": "DISARM",
    "s": "STOP",
    "r": "REACT",
    "c": "CLEAR",
    "n": "RECONNECT",
    "x": "CLOSE",
}
LATCHED = (
    DaemonState.QUICK_STOP_ACTIVE,
    DaemonState.FAULT_REACTION_ACTIVE,
    DaemonState.FAULT,
)
LOST_AT = 0.0
ENERGISED_UNTIL = 0.35


def read_table() -> dict[tuple[DaemonState, Trigger], str]:
    """The entries of the table by state and trigger."""
    table = {}
    for row in ROWS:
        state, *entries = row.split()
        for trigger, entry in zip(TABLE_TRIGGERS, entries, strict=True):
            table[DaemonState(state), trigger] = entry
    return table


HEADER, *ROWS = TABLE.strip().splitlines()
TABLE_TRIGGERS = [Trigger[name] for name in HEADER.split()]
ENTRIES = read_table()


def operations(state: DaemonState) -> Sequence[Operation]:
    """The operations in a state, with a stop that is latched or not where both are possible."""
    latched = Operation(state, "why", None, is_latched=True)
    unlatched = Operation(state, "why", None, is_latched=False)
    return (latched,) if state in LATCHED else (unlatched, latched)


@pytest.mark.parametrize("state", DaemonState)
@pytest.mark.parametrize("trigger", TABLE_TRIGGERS, ids=lambda trigger: trigger.name)
def test_step_follows_table(state: DaemonState, trigger: Trigger) -> None:
    """The next state and the actions are those of the table, whether a stop is latched or not."""
    entry = ENTRIES[state, trigger]
    code, _, letters = entry.partition(":")
    for operation in operations(state):
        next_state = DaemonState(STATE_CODES.get(code, state))
        actions = [Action[ACTION_CODES[letter]] for letter in letters]
        is_opened = (state, trigger) == (DaemonState.NOT_READY, Trigger.OPENED)
        if is_opened and operation.is_latched:
            next_state = DaemonState.QUICK_STOP_ACTIVE
            actions = [Action.STOP]

        event = DaemonEvent(trigger, "because", "do this")
        updated, performed = step(operation, event, LOST_AT)

        assert (updated.state, [*performed]) == (next_state, actions)
        if updated.state is not state:
            is_fault = updated.state in (DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT)
            remedy = fault_remedy("because") if is_fault else "do this"
            assert (updated.cause, updated.remedy) == ("because", remedy)
        assert updated.is_latched or trigger is not Trigger.STOP


@pytest.mark.parametrize(
    "state", [DaemonState.SWITCHED_ON, DaemonState.OPERATION_ENABLED, *LATCHED]
)
def test_step_returns_latched_when_link_lost_while_energised(state: DaemonState) -> None:
    """A loss while energised leads to FAULT, so that it must be acknowledged before arming."""
    operation = Operation(state, is_latched=state in LATCHED)
    loss = DaemonEvent(Trigger.LINK_LOST, "unplugged", "look at cables", amplifiers=("main",))

    lost, _ = step(operation, loss, LOST_AT)
    reconnected, _ = step(lost, DaemonEvent(Trigger.RECONNECTED), ENERGISED_UNTIL)

    assert lost.lost == (LOST_AT, "unplugged", ("main",))
    assert reconnected.state is DaemonState.FAULT
    assert reconnected.cause.endswith("unplugged")
    assert "era clear" in (reconnected.remedy or "")


@pytest.mark.parametrize("state", DaemonState)
def test_unexpected_exception_is_latched(state: DaemonState) -> None:
    """It is a fault where amplifiers are open, and elsewhere one once they are."""
    updated = after_exception(Operation(state), "a bug")

    assert updated.is_latched
    if state in (DaemonState.NOT_READY, DaemonState.COMM_LOST):
        assert updated.state is state
    else:
        assert (updated.state, updated.cause) == (DaemonState.FAULT, "a bug")


def test_remedy_of_every_fault_of_an_amplifier_is_its_own() -> None:
    """Any other cause has the remedy to look for the cause."""
    causes = [f"amplifier main: got FAULT with fault {name}" for name in FAULTS]
    remedies = {fault_remedy(cause) for cause in causes}
    assert len(remedies) == len(FAULTS)
    assert fault_remedy("a bug") == fault_remedy("fault NONE")
