"""Amplifiers that lie to the daemon over real wires, and honest ones, in virtual time."""

import random
from collections.abc import Callable

import pytest

from controller.daemon.states import DaemonState
from drivers.host.timing import HEARTBEAT
from long_form import in_turn, shortly
from supervised_chain import ENABLED, WIRES, supervised_chain
from virtual_loop import run_virtual
from word_lies import Lie, achieved, status

ONE, TWO = ("main",), ("west", "east")
TOUCHES = 0.012  # s; faster than a ramp
SILENCE = 0.1  # s; from a fault to silence


def frozen_watchdog() -> Lie:
    """The first time that is left is that of every status."""
    first: list[int] = []

    def frozen(left: int) -> int:
        first.append(left)
        return first[0]

    return status(watchdog_left=frozen)


def swapped(levels: list[int]) -> list[int]:
    """Exchange channels 0 and 1."""
    return [levels[1], levels[0], *levels[2:]]


def silent(levels: list[int]) -> list[int]:
    """All zero."""
    return [0] * len(levels)


LIES: dict[str, tuple[Callable[[], Lie], str]] = {
    "high voltage off": (lambda: status(flags=lambda flags: flags & ~1), "high voltage must be on"),
    "token one behind": (lambda: status(token=lambda one: one - 1 or 65535), "token must be"),
    "115 Hz for 110": (lambda: achieved(frequency=lambda one: one + 100), "frequency"),
    "phase negated": (lambda: achieved(phase=lambda one: -one), "phase"),
    "watchdog frozen": (frozen_watchdog, "watchdog left must"),
    "channels swapped": (lambda: status(levels=swapped), "level of channel"),
    "all levels zero": (lambda: status(levels=silent), "level of channel"),
}


@pytest.mark.parametrize(("name", "names"), in_turn(LIES, [ONE, TWO]))
def test_lie_ends_in_fault_and_silence(name: str, names: tuple[str, ...]) -> None:
    """Within about two heartbeats or sets, with its reason; all amplifiers are silent then."""
    lie, reason = LIES[name]
    # Sets feed it before it can run down, and levels that change are bounded from above alone.
    moves = names is TWO and name not in ("watchdog frozen", "all levels zero")

    async def main() -> None:
        async with supervised_chain("serial", names) as chain:
            await chain.play(0.3, interval=TOUCHES, moves=moves)
            assert all(any(levels) for levels in chain.levels().values())
            chain.lie(lie(), names[0])
            chain.move()  # another set, for a lie about sets
            await chain.play(0.05, interval=TOUCHES, moves=moves)
            chain.move()
            await chain.play(6 * HEARTBEAT, interval=TOUCHES, moves=moves)
            assert chain.state in (DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT)
            await chain.rest(SILENCE)
            assert f"amplifier {names[0]}" in chain.causes[0]
            assert reason in chain.causes[0]
            assert not any(level for levels in chain.levels().values() for level in levels)

    run_virtual(main(), rng=random.Random(1))


@pytest.mark.parametrize("level", [0.005, 0.0003])
@pytest.mark.parametrize("names", [ONE, TWO], ids=["one", "two"])
def test_dead_weak_channel_ends_in_fault(level: float, names: tuple[str, ...]) -> None:
    """Half a percent of full stroke, and the weakest level that is told from none."""

    async def main() -> None:
        async with supervised_chain("serial", names) as chain:
            chain.table.weak = level
            await chain.play(0.3, interval=TOUCHES, moves=False)
            assert chain.levels()[names[0]][2] == pytest.approx(level)
            chain.lie(status(levels=lambda levels: [*levels[:2], 0]), names[0])
            await chain.play(3 * HEARTBEAT, interval=TOUCHES, moves=False)
            await chain.rest(SILENCE)
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
            assert chain.table.asked > 12

    run_virtual(main(), rng=random.Random(1))
