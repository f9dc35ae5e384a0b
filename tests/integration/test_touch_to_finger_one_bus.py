"""Two amplifiers on one CAN bus under one plate, from a touch stream, in virtual time.

Their ERAs play one frequency together, so that what they differ by in time is felt.
"""

import asyncio
import heapq
import itertools
from collections.abc import Mapping

import numpy as np
import pytest

from drivers.codec.can_bus.canopen import CanFrame
from felt_assertions import CHECKS, Truth, contrasts
from felt_chain import Played, play_stream
from model.finger.grid import Grid
from model.rig.file import load_rig
from model.table.build import build_table
from rig_files import TWO_AMPLIFIERS, write_rig
from sim.far_ends import wires
from sim.far_ends.can_bus.bus import BusNodes, CanBus, Listener
from touch_stream import Stream

SYNC, PERIOD = CanFrame(0x080, b""), 0.01  # s


class MailboxBus(CanBus):
    """A bus as it is at its worst for a host that relies on the order of its frames.

    The host's adapter transmits what waits by priority and, of one identifier, the newest first, as
    controllers with several mailboxes may. Another device sends a SYNC every 10 ms.
    given, transmitted: the host's frames in the order in which they were.
    """

    def __init__(self, bitrate: int | None = None) -> None:
        assert bitrate is not None, "without transmission time no frame waits"
        super().__init__(bitrate)
        self.given: list[CanFrame] = []
        self.transmitted: list[CanFrame] = []
        self._waiting: list[tuple[int, int, CanFrame, Listener]] = []
        self._numbers = itertools.count()
        self._next: asyncio.TimerHandle | None = None
        self._foreign = asyncio.get_running_loop().call_later(PERIOD, self._sync)

    def send(self, frame: CanFrame, *, sender: Listener) -> None:
        if isinstance(getattr(sender, "__self__", None), BusNodes) or frame is SYNC:
            super().send(frame, sender=sender)
            return
        self.given.append(frame)
        heapq.heappush(self._waiting, (frame.id, -next(self._numbers), frame, sender))
        if self._next is None:
            self._transmit()

    def close(self) -> None:
        super().close()
        self._foreign.cancel()
        if self._next is not None:
            self._next.cancel()

    def _transmit(self) -> None:
        self._next = None
        if self._waiting:
            _, _, frame, sender = heapq.heappop(self._waiting)
            self.transmitted.append(frame)
            super().send(frame, sender=sender)
            loop = asyncio.get_running_loop()
            self._next = loop.call_at(self._free_from, self._transmit)

    def _sync(self) -> None:
        self.send(SYNC, sender=lambda frame: None)
        self._foreign = asyncio.get_running_loop().call_later(PERIOD, self._sync)


STREAM = Stream(
    {"A": (0.07, 0.06), "B": (0.04, 0.17), "C": (0.16, 0.19), "D": (0.24, 0.08)},
    [
        (0.1, {1: "B", 2: "C"}),
        (0.8, {1: "B", 2: "C", 3: "D"}),
        (1.4, {}),
        (1.7, {5: "A"}),
        (2.3, {}),
        (2.6, {}),
    ],
)
ONE, TWO = {"main": "slcan"}, {"main": "slcan", "side": "slcan"}
CHANGES: Mapping[str, tuple[tuple[str, str], ...]] = {
    "one": (),
    "two": TWO_AMPLIFIERS,
}


@pytest.fixture(scope="module")
def truths(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Truth]:
    """The rigs as they are meant, and their tables, asked without any of the chain."""
    folder = tmp_path_factory.mktemp("truth")
    made: dict[str, Truth] = {}
    for changes in dict.fromkeys(CHANGES.values()):
        rig = load_rig(write_rig(folder / "rig.yaml", *changes, mesh="auto"))
        table = build_table(rig, frequencies=np.arange(80.0, 321.0, 40.0), grid=Grid(4, 3))
        made |= dict.fromkeys(
            [name for name in CHANGES if CHANGES[name] == changes], Truth(rig, table, STREAM)
        )
    return made


@pytest.fixture(scope="module")
def buses() -> list[MailboxBus]:
    """The buses with a foreign SYNC, whose adapter transmits by priority."""
    return []


@pytest.fixture(scope="module")
def played(
    truths: Mapping[str, Truth],
    buses: list[MailboxBus],
    tmp_path_factory: pytest.TempPathFactory,
) -> Mapping[str, Played]:
    """What came of the stream over one amplifier, and over two on a restless bus."""
    folder = tmp_path_factory.mktemp("chain")

    def restless(bitrate: int | None) -> MailboxBus:
        buses.append(MailboxBus(bitrate))
        return buses[-1]

    results = {}
    for name, changes in CHANGES.items():
        rig = load_rig(write_rig(folder / "rig.yaml", *changes))
        with pytest.MonkeyPatch.context() as patch:
            if changes:
                patch.setattr(wires, "CanBus", restless)
            lines = TWO if changes else ONE
            results[name] = play_stream(STREAM, lines, rig, truths[name].table)
    return results


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("name", CHANGES)
def test_fingers_feel_the_commanded_pattern_over_one_bus(
    played: Mapping[str, Played], truths: Mapping[str, Truth], name: str, check: str
) -> None:
    """What holds for one amplifier holds for two, in whatever order frames are transmitted."""
    CHECKS[check](played[name], truths[name])


def test_contrast_over_two_amplifiers_equals_that_over_one(played: Mapping[str, Played]) -> None:
    """Within 1 dB at every situation: they start together."""
    for alone, together in zip(contrasts(played["one"]), contrasts(played["two"]), strict=True):
        assert together == pytest.approx(alone, abs=1.0)


def test_both_amplifiers_take_part(
    played: Mapping[str, Played], truths: Mapping[str, Truth]
) -> None:
    """Each pattern has ERAs of both, at one frequency."""
    patterns = [pattern for heard in played["two"].heard for pattern in heard.patterns]
    wiring = truths["two"].rig.wiring
    assert len(patterns) == 3
    for pattern in patterns:
        assert {wiring[era].amplifier for era in pattern["drive"]} == {"main", "side"}


def test_frames_were_reordered(played: Mapping[str, Played], buses: list[MailboxBus]) -> None:
    """All frames of a set behind its first went out backwards: two sets of each of three patterns.

    The bus was free for the first when the others were given; an odd number has one in the middle.
    """
    (bus,) = buses
    assert sorted(map(str, bus.given)) == sorted(map(str, bus.transmitted))
    messages = [[*frames] for _, frames in itertools.groupby(bus.given, key=_message)]
    behind = [len(frames) - 1 for frames in messages if len(frames) > 1]
    assert len(behind) == 6
    moved = sum(one is not other for one, other in zip(bus.given, bus.transmitted, strict=True))
    assert moved >= sum(count - count % 2 for count in behind) > 6 * 2


def _message(frame: CanFrame) -> tuple[int, bytes]:
    """Identifier and number, which all frames of a request share."""
    return frame.id, frame.data[:1]
