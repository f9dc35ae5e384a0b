"""The daemon's state machine against a table written by hand, and invariants over histories."""

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.daemon.states import Action, DaemonEvent, DaemonState, StateMachine, Trigger, step

# The whole table by hand, from the states and the fault table of the wire protocol. A dot: nothing
# changes; an asterisk: only under a condition, which has a test of its own.
EVENTS = """
                OPENED VERIFIED ARM ARMED DISARM LEASE_LOST STOP CLEAR FAULT REACTION_DONE LINK_LOST
NOT_READY             SD     .     .   .     .      .          .    .     .     .       .
SWITCH_ON_DISABLED    .      RS    .   .     .      .          QS   .     FR    .       CL
READY_TO_SWITCH_ON    .      .     SO  .     .      .          QS   .     FR    .       CL
SWITCHED_ON           .      .     .   OE    SD     SD         QS   .     FR    .       CL
OPERATION_ENABLED     .      .     .   .     SD     SD         QS   .     FR    .       CL
QUICK_STOP_ACTIVE     .      SD*   .   .     .      .          .    .     FR    .       CL
FAULT_REACTION_ACTIVE .      .     .   .     .      .          .    .     .     FA      CL
FAULT                 .      SD*   .   .     .      .          .    .     .     .       CL
COMM_LOST             .      .     .   .     .      .          .    .     .     .       .
"""
ABBREVIATED = {
    "SD": DaemonState.SWITCH_ON_DISABLED,
    "RS": DaemonState.READY_TO_SWITCH_ON,
    "SO": DaemonState.SWITCHED_ON,
    "OE": DaemonState.OPERATION_ENABLED,
    "QS": DaemonState.QUICK_STOP_ACTIVE,
    "FR": DaemonState.FAULT_REACTION_ACTIVE,
    "FA": DaemonState.FAULT,
    "CL": DaemonState.COMM_LOST,
}
LATCHED = [DaemonState.QUICK_STOP_ACTIVE, DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT]
LOST_AT = 0.0
ENERGISED_UNTIL = LOST_AT + 0.25 + 0.1  # the watchdog's time, and a margin


def grid() -> dict[tuple[DaemonState, Trigger], str]:
    """The table above by state and trigger, without RECONNECTED, TICK and CLOSE."""
    head, *rows = EVENTS.strip("\n").splitlines()
    cells = {}
    for row in rows:
        state, *entries = row.split()
        for trigger, entry in zip(head.split(), entries, strict=True):
            cells[DaemonState(state), Trigger[trigger]] = entry
    return cells


GRID = grid()


def machines(state: DaemonState) -> list[StateMachine]:
    """All machines in a state, with every combination of flags."""
    return [
        StateMachine(state, "why", None, latched, acknowledged, LOST_AT, reopened)
        for latched, acknowledged, reopened in product((False, True), repeat=3)
        if latched or state not in LATCHED
    ]


def test_table_covers_every_state_and_trigger() -> None:
    """The table has every state and trigger except the three with tests of their own."""
    others = {Trigger.RECONNECTED, Trigger.TICK, Trigger.CLOSE}
    assert GRID.keys() == set(product(DaemonState, set(Trigger) - others))


@pytest.mark.parametrize("state", DaemonState)
@pytest.mark.parametrize(
    "trigger",
    [
        trigger
        for trigger in Trigger
        if trigger not in (Trigger.RECONNECTED, Trigger.TICK, Trigger.CLOSE)
    ],
)
def test_step_follows_table(state: DaemonState, trigger: Trigger) -> None:
    """Each of 9 states and 11 triggers leads to the state in the table, whatever the flags."""
    entry = GRID[state, trigger]
    for machine in machines(state):
        after, actions = step(machine, DaemonEvent(trigger, "because", "do this"), LOST_AT)
        conditional = entry.endswith("*") and not machine.is_acknowledged
        expected = state if entry == "." or conditional else ABBREVIATED[entry.rstrip("*")]
        assert after.state is expected
        if after.state is not state:
            assert (after.cause, after.remedy) == ("because", "do this")
            assert not after.is_acknowledged
        if after == machine:
            assert not set(actions) & {Action.ARM, Action.DISARM, Action.VERIFY}


@pytest.mark.parametrize("state", DaemonState)
def test_step_closes_in_every_state(state: DaemonState) -> None:
    """CLOSE leads from every state to NOT_READY and closes the amplifiers."""
    for machine in machines(state):
        after, actions = step(machine, DaemonEvent(Trigger.CLOSE), LOST_AT)
        assert (after.state, actions) == (DaemonState.NOT_READY, (Action.CLOSE,))


@pytest.mark.parametrize(
    "state", [state for state in DaemonState if state is not DaemonState.NOT_READY]
)
def test_step_stops_in_every_open_state(state: DaemonState) -> None:
    """A stop reaches the amplifiers in every open state and latches."""
    for machine in machines(state):
        after, actions = step(machine, DaemonEvent(Trigger.STOP), LOST_AT)
        assert set(actions) & {Action.STOP, Action.REACT}
        assert after.is_latched


@pytest.mark.parametrize("state", [DaemonState.SWITCHED_ON, DaemonState.OPERATION_ENABLED])
@pytest.mark.parametrize(
    "trigger", [Trigger.DISARM, Trigger.LEASE_LOST, Trigger.STOP, Trigger.FAULT]
)
def test_step_silences_when_leaving_energised_state(state: DaemonState, trigger: Trigger) -> None:
    """Every trigger that ends an energised state disarms or stops the amplifiers."""
    _, actions = step(StateMachine(state), DaemonEvent(trigger), LOST_AT)
    assert set(actions) & {Action.DISARM, Action.STOP, Action.REACT}


@pytest.mark.parametrize(
    "state", [DaemonState.SWITCHED_ON, DaemonState.OPERATION_ENABLED, DaemonState.FAULT]
)
def test_step_stops_others_and_reconnects_when_link_lost(state: DaemonState) -> None:
    """Reachable amplifiers are stopped; the lost one counts as energised until its watchdog."""
    after, actions = step(StateMachine(state), DaemonEvent(Trigger.LINK_LOST, "unplugged"), LOST_AT)
    assert actions == (Action.STOP, Action.RECONNECT)
    assert after.assume_energised(LOST_AT)
    assert after.assume_energised(ENERGISED_UNTIL - 0.001)
    assert not after.assume_energised(ENERGISED_UNTIL)


@pytest.mark.parametrize(
    "state", [DaemonState.SWITCHED_ON, DaemonState.OPERATION_ENABLED, *LATCHED]
)
def test_step_returns_latched_when_link_lost_while_energised(state: DaemonState) -> None:
    """A loss while energised leads to FAULT, so that it must be acknowledged before arming."""
    before = StateMachine(state, is_latched=state in LATCHED)
    lost, _ = step(before, DaemonEvent(Trigger.LINK_LOST, "unplugged", "look at cables"), LOST_AT)
    back, _ = step(lost, DaemonEvent(Trigger.RECONNECTED), ENERGISED_UNTIL)
    assert back.state is DaemonState.FAULT
    assert back.cause.endswith("unplugged")
    assert "era clear" in (back.remedy or "")


@pytest.mark.parametrize("trigger", [Trigger.RECONNECTED, Trigger.TICK])
@pytest.mark.parametrize(
    "state", [state for state in DaemonState if state is not DaemonState.COMM_LOST]
)
def test_step_ignores_reconnection_outside_comm_lost(state: DaemonState, trigger: Trigger) -> None:
    """RECONNECTED and TICK change nothing in other states."""
    for machine in machines(state):
        assert step(machine, DaemonEvent(trigger), ENERGISED_UNTIL + 1) == (machine, ())


@pytest.mark.parametrize("latched", [False, True])
def test_step_leaves_comm_lost_when_reconnected_and_watchdog_expired(latched: bool) -> None:
    """Both are required: a reconnection, and the watchdog time with its margin."""
    lost = StateMachine(DaemonState.COMM_LOST, "unplugged", None, latched, False, LOST_AT)
    waiting, actions = step(lost, DaemonEvent(Trigger.TICK), ENERGISED_UNTIL + 1)
    assert (waiting.state, actions) == (DaemonState.COMM_LOST, ())
    early, actions = step(lost, DaemonEvent(Trigger.RECONNECTED), ENERGISED_UNTIL - 0.001)
    assert (early.state, actions) == (DaemonState.COMM_LOST, ())
    late, actions = step(early, DaemonEvent(Trigger.TICK), ENERGISED_UNTIL)
    again, _ = step(lost, DaemonEvent(Trigger.RECONNECTED), ENERGISED_UNTIL)
    assert late.state is again.state
    if latched:
        assert (late.state, actions) == (DaemonState.FAULT, ())
    else:
        assert (late.state, actions) == (DaemonState.SWITCH_ON_DISABLED, (Action.VERIFY,))


def test_step_reconnects_again_when_lost_twice() -> None:
    """A second loss during reconnection starts no second attempt; one after it does."""
    lost, _ = step(StateMachine(DaemonState.SWITCHED_ON), DaemonEvent(Trigger.LINK_LOST), LOST_AT)
    assert step(lost, DaemonEvent(Trigger.LINK_LOST), LOST_AT + 0.1)[1] == ()
    back, _ = step(lost, DaemonEvent(Trigger.RECONNECTED), LOST_AT + 0.1)
    again, actions = step(back, DaemonEvent(Trigger.LINK_LOST), LOST_AT + 0.2)
    assert actions == (Action.RECONNECT,)
    assert (
        step(again, DaemonEvent(Trigger.TICK), ENERGISED_UNTIL + 1)[0].state
        is DaemonState.COMM_LOST
    )


def test_step_requires_new_acknowledgement_after_fault() -> None:
    """A failed read-back revokes the acknowledgement."""
    fault = StateMachine(DaemonState.FAULT, "arc", is_latched=True)
    seen, actions = step(fault, DaemonEvent(Trigger.CLEAR), 0)
    assert actions == (Action.CLEAR,)
    still, _ = step(seen, DaemonEvent(Trigger.FAULT, "arc again"), 0)
    assert (still.state, still.cause) == (DaemonState.FAULT, "arc again")
    assert step(still, DaemonEvent(Trigger.VERIFIED), 0)[0].state is DaemonState.FAULT
    assert (
        step(seen, DaemonEvent(Trigger.VERIFIED, "cleared"), 0)[0].state
        is DaemonState.SWITCH_ON_DISABLED
    )


events = st.lists(st.tuples(st.sampled_from(Trigger), st.floats(0, 0.5)), min_size=1, max_size=40)


@given(events)
def test_step_energises_only_by_arm(history: list[tuple[Trigger, float]]) -> None:
    """OPERATION_ENABLED is entered from SWITCHED_ON, and that by ARM in READY_TO_SWITCH_ON."""
    machine, now = StateMachine(), 0.0
    for trigger, pause in history:
        now += pause
        before, (machine, actions) = machine, step(machine, DaemonEvent(trigger), now)
        if machine.state is DaemonState.OPERATION_ENABLED and before.state is not machine.state:
            assert (before.state, trigger) == (DaemonState.SWITCHED_ON, Trigger.ARMED)
        if machine.state is DaemonState.SWITCHED_ON and before.state is not machine.state:
            assert (before.state, trigger) == (DaemonState.READY_TO_SWITCH_ON, Trigger.ARM)
        if Action.ARM in actions:
            assert machine.state is DaemonState.SWITCHED_ON


@given(events)
def test_step_arms_after_latch_only_when_cleared_and_verified(
    history: list[tuple[Trigger, float]],
) -> None:
    """A stop, fault or loss while energised requires CLEAR and VERIFIED before the next arm."""
    machine, now = StateMachine(), 0.0
    owed: list[Trigger] = []
    for trigger, pause in history:
        now += pause
        before, (machine, _) = machine, step(machine, DaemonEvent(trigger), now)
        if before.state is not DaemonState.NOT_READY and (
            (trigger is Trigger.STOP)
            or (trigger is Trigger.FAULT and before.state is not DaemonState.COMM_LOST)
            or (
                trigger is Trigger.LINK_LOST
                and before.state in (DaemonState.SWITCHED_ON, DaemonState.OPERATION_ENABLED)
            )
        ):
            owed = [Trigger.CLEAR, Trigger.VERIFIED]
        elif owed and trigger is owed[0] and before.state in LATCHED:
            owed = owed[1:]
        if trigger is Trigger.CLOSE:  # a new start reads everything back by itself
            owed = []
        if machine.state is DaemonState.SWITCHED_ON:
            assert not owed
