"""Amplifiers that lie to the daemon over real wires, and honest ones, in virtual time."""

import random
from collections.abc import Callable
from dataclasses import replace

import pytest

from controller.daemon.states import DaemonState
from drivers.operation.watchdog import HEARTBEAT
from drivers.protocol.messages import Reply, Status
from lies import Lie, achieved, status
from long_form import in_turn, shortly
from stop_chain import WIRES
from supervised_chain import ENABLED, supervised_chain
from virtual_loop import run_virtual

ONE, TWO = ("main",), ("west", "east")
TOUCHES = 0.012  # s; faster than a ramp
SILENCE = 0.1  # s; from a fault to silence


def frozen_watchdog() -> Lie:
    """The first time that is left is that of every status."""
    first: list[float] = []

    def lie(reply: Reply) -> Reply:
        if isinstance(reply, Status):
            first.append(reply.watchdog_left)
            return replace(reply, watchdog_left=first[0])
        return reply

    return lie


def swapped(levels: tuple[float, ...]) -> tuple[float, ...]:
    """Exchange channels 0 and 1."""
    return (levels[1], levels[0], *levels[2:])


def silent(levels: tuple[float, ...]) -> tuple[float, ...]:
    """All zero."""
    return (0.0,) * len(levels)


LIES: dict[str, tuple[Callable[[], Lie], str]] = {
    "high voltage off": (lambda: status(high_voltage=False), "high voltage must be on"),
    "token one behind": (lambda: status(token=lambda one: one - 1 or 65535), "playing set must"),
    "115 Hz for 110": (lambda: achieved(frequency=lambda one: one + 5), "frequency achieved"),
    "phase negated": (lambda: achieved(phase=lambda one: -one), "phase achieved"),
    "watchdog frozen": (frozen_watchdog, "watchdog left must"),
    "channels swapped": (lambda: status(levels=swapped), "level of channel"),
    "all levels zero": (lambda: status(levels=silent), "level of channel"),
}


@pytest.mark.parametrize(("name", "names"), in_turn(LIES, [ONE, TWO]))
def test_lie_ends_in_fault_and_silence(name: str, names: tuple[str, ...]) -> None:
    """Within about two heartbeats or sets, with its reason; all amplifiers are silent then."""
    lie, reason = LIES[name]
    moves = names is TWO and name != "watchdog frozen"  # sets feed it before it can run down

    async def main() -> None:
        async with supervised_chain("serial", names) as chain:
            await chain.play(0.3, interval=TOUCHES, moves=moves)
            assert all(any(levels) for levels in chain.levels().values())
            chain.lie(lie(), names[0])
            chain.move()  # another set, for a lie about sets
            await chain.play(6 * HEARTBEAT, interval=TOUCHES, moves=moves)
            assert chain.state in (DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT)
            await chain.rest(SILENCE)
            assert f"amplifier {names[0]}" in chain.causes[0]
            assert reason in chain.causes[0]
            assert not any(level for levels in chain.levels().values() for level in levels)

    run_virtual(main(), rng=random.Random(1))


@pytest.mark.parametrize("level", [0.005, 0.0001])
@pytest.mark.parametrize("names", [ONE, TWO], ids=["one", "two"])
def test_dead_weak_channel_ends_in_fault(level: float, names: tuple[str, ...]) -> None:
    """Half a percent of full stroke, and the weakest level of the wire."""

    async def main() -> None:
        async with supervised_chain("serial", names) as chain:
            chain.table.weak = level
            await chain.play(0.3, interval=TOUCHES, moves=False)
            assert chain.levels()[names[0]][2] == pytest.approx(level)
            chain.lie(status(levels=lambda levels: (*levels[:2], 0.0)), names[0])
            await chain.play(3 * HEARTBEAT, interval=TOUCHES, moves=False)
            assert "level of channel 2" in chain.causes[0]

    run_virtual(main(), rng=random.Random(1))


@pytest.mark.parametrize(
    ("names", "shaped"), [(ONE, False), (TWO, True)], ids=["one-ramps", "two-envelopes"]
)
@pytest.mark.parametrize("wire", shortly(WIRES, ["serial", "socketcand"]))
def test_honest_amplifiers_are_never_a_fault(
    wire: str, names: tuple[str, ...], shaped: bool
) -> None:
    """On every wire, with fast and slow touches, ramps and envelopes, and pauses between."""

    async def main() -> None:
        async with supervised_chain(wire, names, shaped=shaped) as chain:
            for interval in (TOUCHES, 0.031, 0.007, 0.1):
                await chain.play(0.3, interval=interval, moves=True)
                chain.lift()
                await chain.rest(0.07)
            assert chain.causes == []
            assert chain.state is ENABLED
            assert chain.table.asked > 20

    run_virtual(main(), rng=random.Random(1))
