"""What a host owes its amplifiers, and what it owes no more."""

import pytest

from sim.witness.follower import Follower
from sim.witness.host import Host
from sim.witness.plan import AmplifierPlan, Limits, Times
from sim.witness.seen import Answered, Asked, Condition, Drive, Kind
from sim.witness.side import Side

ARM = Asked(Kind.ARM, 1, key=1, watchdog=0.25)
DISARM = Asked(Kind.DISARM, 1, key=2, ramp=0.05)
STOP = Asked(Kind.STOP, 1, key=3, ramp=0.005)
SET = Asked(Kind.APPLY, 1, key=4, token=5, ramp=0.01, drives={0: Drive(110.0, 0.2, 0.0)})
SILENT = Asked(Kind.APPLY, 1, key=5, token=6, ramp=0.01, drives={0: Drive(110.0, 0.0, 0.0)})
NEXT = Asked(Kind.APPLY, 1, key=6, token=7, ramp=0.01, drives={0: Drive(110.0, 0.3, 0.0)})
ENABLED = Condition(4, 0)


class Watched:
    """A host of two armed amplifiers on wires of their own, and the rules that it breaks."""

    def __init__(self) -> None:
        self.broken: list[str] = []
        self.sides = {name: self._side(name) for name in ("west", "east")}
        self.host = Host(self.sides, times=Times())
        for side in self.sides.values():
            side.follower.granted(ARM, Answered(1, ARM.key, condition=ENABLED), 1.0, 1.001)

    def _side(self, name: str) -> Side:
        plan = AmplifierPlan(f"line of {name}", 1, {0: Limits(40.0, 500.0, 1.0)})
        follower = Follower(
            name, plan, times=Times(), complain=self._complain, insist=self._complain
        )
        return Side(name, plan, follower, self._complain, lambda time: False)

    def _complain(self, invariant: str, time: float, sentence: str) -> None:
        self.broken.append(invariant)


@pytest.mark.parametrize(
    ("closed", "broken"),
    [
        ((), ["commit"]),
        (("east",), ["commit"]),  # who has lost the other can silence the one that plays
        (("west", "east"), []),  # it died: nobody is there to tell anybody anything
    ],
)
def test_what_one_plays_all_play_as_long_as_there_is_a_host(
    closed: tuple[str, ...], broken: list[str]
) -> None:
    """A set goes to one of two amplifiers only, then 20 ms pass."""
    watched = Watched()
    watched.host.asked(watched.sides["west"], 1.01, SET)
    for name in closed:
        watched.sides[name].is_open = False
    watched.host.pass_to(1.05)
    assert watched.broken == broken


def test_a_set_that_was_given_up_is_silenced_first() -> None:
    """One plays a set, the last finger lifts before the other does, and for the next finger both
    play another one: right where the first was told to be silent in between, and only there."""
    for silences, broken in (((SILENT,), []), ((), ["commit"])):
        watched = Watched()
        watched.host.asked(watched.sides["west"], 1.010, SET)
        for silent in silences:
            watched.host.asked(watched.sides["west"], 1.014, silent)
        for side in watched.sides.values():
            watched.host.asked(side, 1.020, NEXT)
        watched.host.pass_to(1.05)
        assert watched.broken == broken


def test_a_disarm_is_not_what_a_stop_is() -> None:
    """A stop is wished, and the amplifier is told to disarm first, along ten times the ramp."""
    watched = Watched()
    watched.host.wish(1.010, "stop")
    watched.host.asked(watched.sides["west"], 1.011, DISARM)
    watched.host.asked(watched.sides["west"], 1.013, STOP)
    assert watched.broken == ["stop"]
