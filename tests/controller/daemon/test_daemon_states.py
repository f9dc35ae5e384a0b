from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.daemon.states import Action, Event, Kind, Machine, State, step

# The whole table by hand, from the states and the fault table of the wire protocol. A dot: nothing
# changes; an asterisk: only under a condition, which has a test of its own.
EVENTS = """
                      OPENED SOUND ARM ARMED DISARM LEASE_LOST STOP CLEAR FAULT REACTED LINK_LOST
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
    "SD": State.SWITCH_ON_DISABLED,
    "RS": State.READY_TO_SWITCH_ON,
    "SO": State.SWITCHED_ON,
    "OE": State.OPERATION_ENABLED,
    "QS": State.QUICK_STOP_ACTIVE,
    "FR": State.FAULT_REACTION_ACTIVE,
    "FA": State.FAULT,
    "CL": State.COMM_LOST,
}
LATCHED = [State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE, State.FAULT]
LOST_AT = 0.0
ENERGISED_UNTIL = LOST_AT + 0.25 + 0.1  # the watchdog's time, and a margin


def grid() -> dict[tuple[State, Kind], str]:
    """The table above, by state and event; REOPENED, TICK and CLOSE are not in it."""
    head, *rows = EVENTS.strip("\n").splitlines()
    cells = {}
    for row in rows:
        state, *entries = row.split()
        for kind, entry in zip(head.split(), entries, strict=True):
            cells[State(state), Kind[kind]] = entry
    return cells


GRID = grid()


def machines(state: State) -> list[Machine]:
    """Every machine in a state, whatever else it remembers."""
    return [
        Machine(state, "why", None, latched, acknowledged, LOST_AT, reopened)
        for latched, acknowledged, reopened in product((False, True), repeat=3)
        if latched or state not in LATCHED
    ]


def test_the_grid_is_complete() -> None:
    """Every state with every event, but the three that stand in tests of their own."""
    others = {Kind.REOPENED, Kind.TICK, Kind.CLOSE}
    assert GRID.keys() == set(product(State, set(Kind) - others))


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize(
    "kind", [kind for kind in Kind if kind not in (Kind.REOPENED, Kind.TICK, Kind.CLOSE)]
)
def test_every_event_in_every_state(state: State, kind: Kind) -> None:
    """Where each of 9 states goes at each of 11 events, whatever else is remembered."""
    entry = GRID[state, kind]
    for machine in machines(state):
        after, actions = step(machine, Event(kind, "because", "do this"), LOST_AT)
        conditional = entry.endswith("*") and not machine.acknowledged
        expected = state if entry == "." or conditional else ABBREVIATED[entry.rstrip("*")]
        assert after.state is expected
        if after.state is not state:
            assert (after.cause, after.remedy) == ("because", "do this")
            assert not after.acknowledged
        if after == machine:
            assert not set(actions) & {Action.ARM, Action.DISARM, Action.VERIFY}


@pytest.mark.parametrize("state", State)
def test_the_daemon_can_end_in_every_state(state: State) -> None:
    """CLOSE leads to NOT_READY and closes the amplifiers, from anywhere."""
    for machine in machines(state):
        after, actions = step(machine, Event(Kind.CLOSE), LOST_AT)
        assert (after.state, actions) == (State.NOT_READY, (Action.CLOSE,))


@pytest.mark.parametrize("state", [state for state in State if state is not State.NOT_READY])
def test_stop_reaches_the_amplifiers_in_every_state(state: State) -> None:
    """Once anything is open, a stop goes to the amplifiers, and somebody must acknowledge it."""
    for machine in machines(state):
        after, actions = step(machine, Event(Kind.STOP), LOST_AT)
        assert set(actions) & {Action.STOP, Action.REACT}
        assert after.latched


@pytest.mark.parametrize("state", [State.SWITCHED_ON, State.OPERATION_ENABLED])
@pytest.mark.parametrize("kind", [Kind.DISARM, Kind.LEASE_LOST, Kind.STOP, Kind.FAULT])
def test_leaving_an_energised_state_silences_the_amplifiers(state: State, kind: Kind) -> None:
    """Whatever ends it, the amplifiers are told."""
    _, actions = step(Machine(state), Event(kind), LOST_AT)
    assert set(actions) & {Action.DISARM, Action.STOP, Action.REACT}


@pytest.mark.parametrize("state", [State.SWITCHED_ON, State.OPERATION_ENABLED, State.FAULT])
def test_a_lost_link_stops_the_others_and_reconnects(state: State) -> None:
    """What can still be reached is stopped, and until then nobody takes the lost one for silent."""
    after, actions = step(Machine(state), Event(Kind.LINK_LOST, "unplugged"), LOST_AT)
    assert actions == (Action.STOP, Action.RECONNECT)
    assert after.assume_energised(LOST_AT)
    assert after.assume_energised(ENERGISED_UNTIL - 0.001)
    assert not after.assume_energised(ENERGISED_UNTIL)


@pytest.mark.parametrize("state", [State.SWITCHED_ON, State.OPERATION_ENABLED, *LATCHED])
def test_a_link_that_was_lost_while_energised_comes_back_latched(state: State) -> None:
    """Nothing is armed again before somebody has acknowledged that it was lost."""
    before = Machine(state, latched=state in LATCHED)
    lost, _ = step(before, Event(Kind.LINK_LOST, "unplugged", "look at cables"), LOST_AT)
    back, _ = step(lost, Event(Kind.REOPENED), ENERGISED_UNTIL)
    assert back.state is State.FAULT
    # What it was lost for is no longer how it is, and somebody has to be told what to do now.
    assert back.cause.startswith("all amplifiers answer again")
    assert back.cause.endswith("unplugged")
    assert "era clear" in (back.remedy or "")


@pytest.mark.parametrize("kind", [Kind.REOPENED, Kind.TICK])
@pytest.mark.parametrize("state", [state for state in State if state is not State.COMM_LOST])
def test_only_a_lost_link_can_come_back(state: State, kind: Kind) -> None:
    """In other states a link that comes back, or time that passes, means nothing."""
    for machine in machines(state):
        assert step(machine, Event(kind), ENERGISED_UNTIL + 1) == (machine, ())


@pytest.mark.parametrize("latched", [False, True])
def test_a_lost_link_is_left_when_it_is_back_and_silent_for_sure(latched: bool) -> None:
    """Both are needed: reopened, and the watchdog's time with its margin over."""
    lost = Machine(State.COMM_LOST, "unplugged", None, latched, False, LOST_AT)
    waiting, actions = step(lost, Event(Kind.TICK), ENERGISED_UNTIL + 1)
    assert (waiting.state, actions) == (State.COMM_LOST, ())
    early, actions = step(lost, Event(Kind.REOPENED), ENERGISED_UNTIL - 0.001)
    assert (early.state, actions) == (State.COMM_LOST, ())
    late, actions = step(early, Event(Kind.TICK), ENERGISED_UNTIL)
    again, _ = step(lost, Event(Kind.REOPENED), ENERGISED_UNTIL)
    assert late.state is again.state
    if latched:  # it was energised, stopped or in a fault: somebody must acknowledge
        assert (late.state, actions) == (State.FAULT, ())
    else:
        assert (late.state, actions) == (State.SWITCH_ON_DISABLED, (Action.VERIFY,))


def test_a_link_that_is_lost_again_while_it_is_waited_for_reconnects_again() -> None:
    """Reopened and lost once more before the time has passed: another attempt, no double one."""
    lost, _ = step(Machine(State.SWITCHED_ON), Event(Kind.LINK_LOST), LOST_AT)
    assert step(lost, Event(Kind.LINK_LOST), LOST_AT + 0.1)[1] == ()
    back, _ = step(lost, Event(Kind.REOPENED), LOST_AT + 0.1)
    again, actions = step(back, Event(Kind.LINK_LOST), LOST_AT + 0.2)
    assert actions == (Action.RECONNECT,)
    assert step(again, Event(Kind.TICK), ENERGISED_UNTIL + 1)[0].state is State.COMM_LOST


def test_a_fault_after_the_acknowledgement_needs_another() -> None:
    """Cause gone, acknowledged, level zero, in order: a failed read-back takes the word back."""
    fault = Machine(State.FAULT, "arc", latched=True)
    seen, actions = step(fault, Event(Kind.CLEAR), 0)
    assert actions == (Action.CLEAR,)
    still, _ = step(seen, Event(Kind.FAULT, "arc again"), 0)
    assert (still.state, still.cause) == (State.FAULT, "arc again")
    assert step(still, Event(Kind.SOUND), 0)[0].state is State.FAULT
    assert step(seen, Event(Kind.SOUND, "cleared"), 0)[0].state is State.SWITCH_ON_DISABLED


events = st.lists(st.tuples(st.sampled_from(Kind), st.floats(0, 0.5)), min_size=1, max_size=40)


@given(events)
def test_no_history_energises_without_being_armed(history: list[tuple[Kind, float]]) -> None:
    """OPERATION_ENABLED is entered from SWITCHED_ON, and that by ARM in READY_TO_SWITCH_ON."""
    machine, now = Machine(), 0.0
    for kind, pause in history:
        now += pause
        before, (machine, actions) = machine, step(machine, Event(kind), now)
        if machine.state is State.OPERATION_ENABLED and before.state is not machine.state:
            assert (before.state, kind) == (State.SWITCHED_ON, Kind.ARMED)
        if machine.state is State.SWITCHED_ON and before.state is not machine.state:
            assert (before.state, kind) == (State.READY_TO_SWITCH_ON, Kind.ARM)
        if Action.ARM in actions:
            assert machine.state is State.SWITCHED_ON


@given(events)
def test_no_history_forgets_what_was_latched(history: list[tuple[Kind, float]]) -> None:
    """Between a stop, fault or loss while energised and the next arm: CLEAR, and then SOUND."""
    machine, now = Machine(), 0.0
    owed: list[Kind] = []
    for kind, pause in history:
        now += pause
        before, (machine, _) = machine, step(machine, Event(kind), now)
        if before.state is not State.NOT_READY and (
            (kind is Kind.STOP)
            or (kind is Kind.FAULT and before.state is not State.COMM_LOST)
            or (
                kind is Kind.LINK_LOST
                and before.state in (State.SWITCHED_ON, State.OPERATION_ENABLED)
            )
        ):
            owed = [Kind.CLEAR, Kind.SOUND]
        elif owed and kind is owed[0] and before.state in LATCHED:
            owed = owed[1:]
        if kind is Kind.CLOSE:  # a new start reads everything back by itself
            owed = []
        if machine.state is State.SWITCHED_ON:
            assert not owed
