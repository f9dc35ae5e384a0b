"""What is played before the witness: an ordinary day, and days on which something is wrong."""

import asyncio
import contextlib
import random
import re

import hand_written as hand
from drivers.by_hand import reaching
from drivers.errors import CommandRefused
from drivers.protocol.sets import LayerSet, pack_layers, parts
from witnessed_chain import Chain, with_level


async def day(chain: Chain) -> None:
    """Touches, a neighbour, a lift, a stop amid a touch, clearing, arming, disarming."""
    await chain.operate("arm", rest=0.12)
    await chain.touch(1, rest=0.1)
    await chain.touch(1, 2, rest=0.12)
    await chain.touch(1, rest=0.05)
    await chain.touch(rest=0.1)
    await chain.touch(3, rest=0.1)
    await chain.operate("stop", rest=0.1)
    await chain.touch()
    await chain.operate("clear")
    await chain.operate("arm")
    await chain.touch(4, rest=0.06)
    await chain.touch(rest=0.06)
    await chain.operate("disarm", rest=0.1)


async def hasty(chain: Chain) -> None:
    """Other fingers touch every 4 ms, within the ramp of a pattern."""
    await chain.operate("arm", rest=0.12)
    for _ in range(5):
        await chain.touch(1, rest=0.004)
        await chain.touch(1, 2, rest=0.004)
    await chain.rest(0.1)
    await chain.touch(rest=0.06)


async def hung(chain: Chain) -> None:
    """The control loop stalls during a touch; a client polls the status, clears and rearms."""
    await chain.operate("arm")
    await chain.touch(1, rest=0.1)
    await chain.hang()
    for _ in range(20):
        await chain.rest(0.02)
        await chain.amplifier.read_status()
    await chain.touch()
    await chain.operate("clear", rest=0.05)
    chain.run()
    await chain.operate("arm")
    await chain.touch(2, rest=0.06)
    await chain.touch(rest=0.06)


async def source_dies(chain: Chain) -> None:
    """The source of touches dies with a finger down."""
    await chain.operate("arm")
    await chain.touch(1, rest=0.1)
    await chain.fall_silent()
    await chain.rest(0.1)


async def slow_stop(chain: Chain) -> None:
    """An amplifier with late replies is stopped before one."""
    await chain.operate("arm", rest=0.02)
    chain.between.delay = 0.025
    await chain.touch(1, rest=0.001)
    await chain.operate("stop")
    await chain.touch(rest=0.05)
    chain.between.delay = 0.0
    await chain.rest(0.05)


async def slow_lift(chain: Chain) -> None:
    """The last finger is lifted before a late reply to its touch."""
    await chain.operate("arm", rest=0.02)
    chain.between.delay = 0.025
    await chain.touch(1, rest=0.001)
    await chain.touch(rest=0.05)
    chain.between.delay = 0.0
    await chain.rest(0.05)


async def too_loud(chain: Chain) -> None:
    """The table asks for more than full level on one ERA: nothing must play."""
    chain.table.alone = with_level(chain.table.alone, "NE", 0.7)
    await _unanswerable(chain)


async def too_high(chain: Chain) -> None:
    """The table asks for a frequency that is not allowed."""
    chain.table.alone = with_level(chain.table.alone, "NE", 0.4, frequency=620.0)
    await _unanswerable(chain)


async def not_a_number(chain: Chain) -> None:
    """The table is damaged: a phase is NaN."""
    chain.table.alone = with_level(chain.table.alone, "NE", 0.4, phase=float("nan"))
    await _unanswerable(chain)


async def _unanswerable(chain: Chain) -> None:
    await chain.operate("arm")
    await chain.touch(1, answerable=False)
    chain.witness.expect(None)
    await chain.rest(0.1)
    await chain.touch(rest=0.05)


async def reopened(chain: Chain) -> None:
    """Everything is closed, opened again and armed."""
    await chain.operate("arm", rest=0.05)
    await chain.reopen()
    await chain.operate("arm")
    await chain.touch(1, rest=0.06)
    await chain.touch(rest=0.05)


async def arc(chain: Chain) -> None:
    """An amplifier has a fault of its own while a finger is felt; later it is cleared."""
    await chain.operate("arm")
    await chain.touch(1, rest=0.06)
    chain.trip()
    for _ in range(10):
        await chain.rest(0.02)
        await chain.amplifier.read_status()
    await chain.touch()
    await chain.operate("clear", rest=0.05)


async def asked(chain: Chain) -> None:
    """An amplifier trips, is asked for its faults, and identifies itself again."""
    await chain.operate("arm")
    await chain.touch(1, rest=0.06)
    chain.trip()
    await chain.rest(0.02)
    await chain.amplifier.read_status()
    await reaching.request(chain.amplifier, "GetFaults", {})
    await chain.touch(rest=0.1)
    await chain.operate("clear", rest=0.05)
    await chain.amplifier.identify()
    chain.trip()
    await reaching.request(chain.amplifier, "GetFaults", {})


async def noise(chain: Chain) -> None:
    """A damaged stop comes to the amplifier, which must not mind it."""
    await chain.operate("arm")
    await chain.touch(1, rest=0.06)
    chain.disturb()
    chain.inject("amplifier", _damaged(hand.frame(hand.STOP, (5,), sequence=999)))
    await chain.rest(0.1)
    chain.disturb(False)
    await chain.touch(rest=0.05)


async def late_copy(chain: Chain) -> None:
    """The first set that vibrated comes once more, after others: a stale frame."""
    kept: list[bytes] = []

    def keep(toward: str, data: bytes) -> bytes:
        if toward == "amplifier":
            kept.append(data)
        return data

    await chain.operate("arm")
    chain.between.mangle = keep
    await chain.touch(1, rest=0.03)
    await chain.touch(1, 2, rest=0.1)
    chain.disturb()
    stale = next(data for data in kept if len(data) > 30)
    chain.inject("amplifier", stale)
    await chain.rest(0.1)
    chain.disturb(False)
    await chain.touch(rest=0.05)


async def damaged_answer(chain: Chain) -> None:
    """The answer to a heartbeat is damaged, and a finger comes meanwhile."""
    damaged = asyncio.Event()

    def damage(toward: str, data: bytes) -> bytes:
        if toward == "host" and not damaged.is_set():
            damaged.set()
            return _damaged(data)
        return data

    await chain.operate("arm", rest=0.02)
    chain.disturb()
    chain.between.mangle = damage
    await damaged.wait()
    await chain.rest(0.005)
    await chain.touch(1, rest=0.15)
    await chain.touch(rest=0.05)


def _damaged(data: bytes) -> bytes:
    """A frame with another checksum, and without a zero byte in it."""
    at = len(data) - 4
    return data[:at] + bytes([data[at] ^ 0x55 or 1]) + data[at + 1 :]


async def foreign_answer(chain: Chain) -> None:
    """Instead of the answer to a status comes that to an earlier one, and a finger."""
    kept: list[bytes] = []
    replaced = asyncio.Event()

    def replace(toward: str, data: bytes) -> bytes:
        if toward != "host" or replaced.is_set():
            return data
        kept.append(data)
        if len(kept) > 2 and len(data) == len(kept[-3]):  # a heartbeat's is between them
            replaced.set()
            return kept[-3]
        return data

    await chain.operate("arm", rest=0.02)
    chain.disturb()
    chain.between.mangle = replace
    await replaced.wait()
    await chain.rest(0.005)
    await chain.touch(1, rest=0.15)
    await chain.touch(rest=0.05)


async def incomplete_set(chain: Chain) -> None:
    """On CAN the second frame of a set is lost."""
    lost = asyncio.Event()

    def lose(toward: str, data: bytes) -> bytes:
        second = re.search(rb"t2018..01[^\r]*\r", data)
        if toward == "amplifier" and second is not None and not lost.is_set():
            lost.set()
            return data.replace(second[0], b"", 1)
        return data

    await chain.operate("arm", rest=0.02)
    chain.disturb()
    chain.between.mangle = lose
    await chain.touch(1, rest=0.1)
    await chain.touch(rest=0.05)


async def slow_touch(chain: Chain) -> None:
    """A finger comes and a client polls the status while a heartbeat's reply is in flight."""
    asked = asyncio.Event()

    def look(toward: str, data: bytes) -> bytes:
        if toward == "amplifier":
            asked.set()
        return data

    await chain.operate("arm", rest=0.02)
    chain.between.delay = 0.020
    chain.between.mangle = look
    await asked.wait()
    await chain.rest(0.005)
    await chain.touch(1)
    await chain.amplifier.read_status()
    await chain.rest(0.1)
    chain.between.delay = 0.0
    await chain.touch(rest=0.05)


async def disarmed_amid(chain: Chain) -> None:
    """It is disarmed while a finger is felt."""
    await chain.operate("arm")
    await chain.touch(1, rest=0.06)
    await chain.operate("disarm", rest=0.1)
    await chain.amplifier.read_status()
    await chain.touch()


async def strangers_set(chain: Chain) -> None:
    """A program that goes round the controller sends a silent set to a disarmed amplifier."""
    await chain.rest(0.02)
    await chain.amplifier.read_status()
    stream = pack_layers([LayerSet(0, 0, 0)])
    (silent,) = parts(stream, session=9, token=7, now=True)
    with contextlib.suppress(CommandRefused):
        await reaching.request(chain.amplifier, "Set", silent)
    await chain.rest(0.02)


async def strangers_heartbeat(chain: Chain) -> None:
    """Another program feeds the watchdog while a finger is felt; on CAN it is the same host."""
    await chain.operate("arm")
    await chain.touch(1, rest=0.06)
    own = chain.amplifier.session
    with contextlib.suppress(CommandRefused):
        await reaching.request(chain.amplifier, "Ping", {"session": own % 65535 + 1})
    await chain.touch(rest=0.05)


async def touched_beside(chain: Chain) -> None:
    """A touch source reports a finger beside the plate."""
    await chain.operate("arm", rest=0.05)
    chain.touch_beside()
    await chain.rest(0.1)


async def rough(chain: Chain) -> None:
    """Every twelfth frame is lost and as many have a bit flipped, while fingers come and go."""
    await _spoilt(chain, flips=True)


async def lossy(chain: Chain) -> None:
    """The same where only losses are possible: the text of a CAN adapter has no checksum."""
    await _spoilt(chain, flips=False)


async def _spoilt(chain: Chain, *, flips: bool) -> None:
    rng = random.Random(chain.loop.rng.random())

    def spoil(toward: str, data: bytes) -> bytes | None:
        fate = rng.random()
        if fate < 1 / 12:
            return None
        if flips and fate < 1 / 6:
            at, bit = rng.randrange(len(data)), rng.randrange(8)
            return data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]
        return data

    await chain.operate("arm")
    await chain.touch(1, rest=0.1)
    chain.disturb()
    chain.between.mangle = spoil
    for _ in range(6):
        await chain.touch(1, rest=0.08)
        await chain.touch(rest=0.05)
    chain.between.mangle = lambda toward, data: data
    chain.disturb(False)
    await chain.rest(0.6)
    await chain.touch(2, rest=0.12)
    await chain.touch(rest=0.05)
