"""What one amplifier must be doing by the table of states, and what is said where it is not."""

import pytest

from sim.witness.follower import Follower
from sim.witness.plan import AmplifierPlan, Limits, Times
from sim.witness.seen import Answered, Asked, Condition, Kind

PLAN = AmplifierPlan("line", 1, {0: Limits(40.0, 500.0, 1.0)})
ARM = Asked(Kind.ARM, 1, key=1, watchdog=0.25)
STOP = Asked(Kind.STOP, 1, key=2)
# docs/reference/wire-protocol.md, States and Fault.
ENABLED, STOPPED, REACTING, FAULT = 4, 5, 6, 7
WATCHDOG = 1


class Watched:
    """A follower with the rules that it finds broken."""

    def __init__(self) -> None:
        self.broken: list[str] = []
        self.follower = Follower(
            "main", PLAN, times=Times(), complain=self._complain, insist=self._complain
        )

    def grants(self, asked: Asked, begin: float, state: int, fault: int = 0) -> None:
        """A request at a time [s], and an answer 2 ms later that says how it is."""
        condition = Condition(state, fault, high_voltage=state == ENABLED)
        answer = Answered(1, asked.key, condition=condition)
        self.follower.granted(asked, answer, begin, begin + 0.002)

    def _complain(self, invariant: str, time: float, sentence: str) -> None:
        self.broken.append(invariant)


def test_who_is_not_known_may_have_been_in_a_fault_before_a_stop() -> None:
    """Armed, lost sight of, stopped: its watchdog may have run out while nobody looked."""
    watched = Watched()
    watched.grants(ARM, 1.0, ENABLED)
    watched.follower.lose_track()
    watched.grants(STOP, 9.0, FAULT, WATCHDOG)
    assert watched.broken == []


def test_a_fault_that_was_cleared_out_of_sight_is_not_latched() -> None:
    """In a fault, lost sight of, cleared and armed meanwhile, stopped: it has no fault any more."""
    watched = Watched()
    watched.grants(ARM, 1.0, ENABLED)
    watched.follower.told(FAULT, WATCHDOG, 2.0)
    watched.follower.lose_track()
    watched.grants(STOP, 9.0, STOPPED)
    assert watched.broken == []


def test_who_is_known_may_not() -> None:
    """Ten milliseconds after Arm no watchdog of 250 ms has run out."""
    watched = Watched()
    watched.grants(ARM, 1.0, ENABLED)
    watched.grants(STOP, 1.01, FAULT, WATCHDOG)
    assert watched.broken == ["watchdog"]


@pytest.mark.parametrize("state", [1, 3, ENABLED])
def test_who_is_not_known_follows_a_stop_all_the_same(state: int) -> None:
    """From every state Stop leads to one that is latched."""
    watched = Watched()
    watched.grants(STOP, 1.0, state)
    assert len(watched.broken) == 1
