"""The operation's states against a table written by hand."""

import pytest

from controller.operation.operation_states import (
    Action,
    DaemonEvent,
    DaemonState,
    Operation,
    Trigger,
    acknowledge,
    failed,
    step,
)
from drivers.protocol.definition import FAULTS

# The whole table by hand, from the states and the fault table of the wire protocol: the next state
# (= for the same) and the actions in order. A dot: nothing changes. Conditions have tests of their
# own.
EVENTS = """
OPENED NOT_FOUND VERIFIED ARM ARMED DISARM STOP CLEAR FAULT REACTION_DONE LINK_LOST CLOSE
NOT_READY             SD:v CL:n .    .    .   .     =:s  .   .    .   .     NR:x
SWITCH_ON_DISABLED    .    .    RS:  .    .   .     QS:s .   FR:r .   CL:sn NR:x
READY_TO_SWITCH_ON    .    .    .    SO:a .   .     QS:s .   FR:r .   CL:n  NR:x
SWITCHED_ON           .    .    .    .    OE: SD:dv QS:s .   FR:r .   CL:sn NR:x
OPERATION_ENABLED     .    .    .    .    .   SD:dv QS:s .   FR:r .   CL:sn NR:x
QUICK_STOP_ACTIVE     .    .    SD:v .    .   .     =:s  =:c FR:r .   CL:sn NR:x
FAULT_REACTION_ACTIVE .    .    .    .    .   .     =:s  .   .    FA: CL:sn NR:x
FAULT                 .    .    SD:v .    .   .     =:s  =:c =:s  .   CL:sn NR:x
COMM_LOST             .    .    .    .    .   .     =:s  .   .    .   =:n   NR:x
"""
STATES = {
    "NR": DaemonState.NOT_READY,
    "SD": DaemonState.SWITCH_ON_DISABLED,
    "RS": DaemonState.READY_TO_SWITCH_ON,
    "SO": DaemonState.SWITCHED_ON,
    "OE": DaemonState.OPERATION_ENABLED,
    "QS": DaemonState.QUICK_STOP_ACTIVE,
    "FR": DaemonState.FAULT_REACTION_ACTIVE,
    "FA": DaemonState.FAULT,
    "CL": DaemonState.COMM_LOST,
}
ACTIONS = {
    "v": Action.VERIFY,
    "a": Action.ARM,
    "d": Action.DISARM,
    "s": Action.STOP,
    "r": Action.REACT,
    "c": Action.CLEAR,
    "n": Action.RECONNECT,
    "x": Action.CLOSE,
}
UNTABLED = (Trigger.RECONNECTED, Trigger.LINK_CHANGED)
LATCHED = [DaemonState.QUICK_STOP_ACTIVE, DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT]
LOST_AT, ENERGISED_UNTIL = 0.0, 0.35


def grid() -> dict[tuple[DaemonState, Trigger], str]:
    """The table above by state and trigger, without those that have tests of their own."""
    head, *rows = EVENTS.strip("\n").splitlines()
    cells = {}
    for row in rows:
        state, *entries = row.split()
        for trigger, entry in zip(head.split(), entries, strict=True):
            cells[DaemonState(state), Trigger[trigger]] = entry
    return cells


def operations(state: DaemonState) -> list[Operation]:
    """All operations in a state, with every combination of flags."""
    return [
        Operation(state, "why", None, latched)
        for latched in (False, True)
        if latched or state not in LATCHED
    ]


@pytest.mark.parametrize("state", DaemonState)
@pytest.mark.parametrize(
    "trigger", [each for each in Trigger if each not in UNTABLED], ids=lambda each: each.name
)
def test_step_follows_table(state: DaemonState, trigger: Trigger) -> None:
    """The next state and the actions are those of the table, whatever the flags."""
    entry = grid()[state, trigger]
    to, _, letters = entry.partition(":")
    for operation in operations(state):
        after, actions = step(operation, DaemonEvent(trigger, "because", "do this"), LOST_AT)
        match trigger:
            case Trigger.OPENED if state is DaemonState.NOT_READY and operation.is_latched:
                expected = (DaemonState.QUICK_STOP_ACTIVE, [Action.STOP])
            case _:
                expected = (STATES.get(to, state), [ACTIONS[letter] for letter in letters])
        assert (after.state, [*actions]) == expected
        if after.state is not state:
            is_fault = after.state in (DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT)
            remedy = acknowledge("because") if is_fault else "do this"
            assert (after.cause, after.remedy) == ("because", remedy)
        if trigger is Trigger.STOP:
            assert after.is_latched


@pytest.mark.parametrize(
    "state", [DaemonState.SWITCHED_ON, DaemonState.OPERATION_ENABLED, *LATCHED]
)
def test_step_returns_latched_when_link_lost_while_energised(state: DaemonState) -> None:
    """A loss while energised leads to FAULT, so that it must be acknowledged before arming."""
    before = Operation(state, is_latched=state in LATCHED)
    unplugged = DaemonEvent(
        Trigger.LINK_LOST,
        *("unplugged", "look at cables"),
        amplifiers=("main",),
    )
    lost, _ = step(before, unplugged, LOST_AT)
    assert lost.lost == (LOST_AT, "unplugged", ("main",))
    back, _ = step(lost, DaemonEvent(Trigger.RECONNECTED), ENERGISED_UNTIL)
    assert back.state is DaemonState.FAULT
    assert back.cause.endswith("unplugged")
    assert "era clear" in (back.remedy or "")


@pytest.mark.parametrize("state", DaemonState)
def test_step_leaves_comm_lost_alone_when_reconnected(state: DaemonState) -> None:
    """For FAULT if anything is latched; in other states nothing changes."""
    for operation in operations(state):
        after, actions = step(operation, DaemonEvent(Trigger.RECONNECTED), ENERGISED_UNTIL)
        if state is not DaemonState.COMM_LOST:
            assert (after, actions) == (operation, ())
        elif operation.is_latched:
            assert (after.state, actions) == (DaemonState.FAULT, ())
        else:
            assert (after.state, actions) == (DaemonState.SWITCH_ON_DISABLED, (Action.VERIFY,))


@pytest.mark.parametrize("state", DaemonState)
def test_degraded_link_changes_no_state(state: DaemonState) -> None:
    """Its cause is said while armed."""
    before = Operation(state, "why")
    degraded, actions = step(before, DaemonEvent(Trigger.LINK_CHANGED, "no reply"), 0.0)
    is_armed = state is DaemonState.OPERATION_ENABLED
    assert (degraded.state, degraded.cause, actions) == (
        state,
        "no reply" if is_armed else "why",
        (),
    )


@pytest.mark.parametrize("state", DaemonState)
def test_unexpected_exception_is_latched(state: DaemonState) -> None:
    """It is a fault where amplifiers are open, and elsewhere one once they are."""
    after = failed(Operation(state), "a bug")
    assert after.is_latched
    if state in (DaemonState.NOT_READY, DaemonState.COMM_LOST):
        assert after.state is state
    else:
        assert (after.state, after.cause) == (DaemonState.FAULT, "a bug")


def test_remedy_of_every_fault_of_an_amplifier_is_its_own() -> None:
    """In whatever words it is reported; of any other cause it is to find it."""
    remedies = {acknowledge(f"amplifier main: got FAULT with fault {name}") for name in FAULTS}
    assert len(remedies) == len(FAULTS)
    assert acknowledge("a bug") == acknowledge("fault NONE")
