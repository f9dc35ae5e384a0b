"""What is played before the witness: an ordinary day, and days on which something is wrong."""

import asyncio
import contextlib
import random

from drivers.errors import CommandRefused
from drivers.guard import Guard, GuardLimits
from witnessed_chain import Chain, with_level

_STOP = bytes.fromhex("0005080201070205055ED58B3F00")  # one bit of its CRC is wrong


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
        await chain.amplifier.status()
    await chain.touch()
    await chain.operate("clear", rest=0.05)
    await chain.operate("arm")
    chain.run()
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
        await chain.amplifier.status()
    await chain.touch()
    await chain.operate("clear", rest=0.05)


async def asked(chain: Chain) -> None:
    """An amplifier trips, is asked for its faults, and identifies itself again."""
    await chain.operate("arm")
    await chain.touch(1, rest=0.06)
    chain.trip()
    await chain.rest(0.02)
    await chain.amplifier.status()
    await chain.amplifier.faults()
    await chain.touch()
    await chain.operate("clear", rest=0.05)
    await chain.amplifier.identify()
    chain.trip()
    await chain.amplifier.faults()


async def noise(chain: Chain) -> None:
    """Damaged frames come to the amplifier (a stop and a ping), which must not mind them."""
    await chain.operate("arm")
    await chain.touch(1, rest=0.06)
    chain.disturb()
    chain.inject("amplifier", _STOP)
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
            at = len(data) - 4  # in the checksum, and never a zero byte
            return data[:at] + bytes([data[at] ^ 0x55 or 1]) + data[at + 1 :]
        return data

    await chain.operate("arm", rest=0.02)
    chain.disturb()
    chain.between.mangle = damage
    await damaged.wait()
    await chain.rest(0.005)
    await chain.touch(1, rest=0.15)
    await chain.touch(rest=0.05)


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
    """On CAN the frame of one channel is lost."""
    lost = asyncio.Event()

    def lose(toward: str, data: bytes) -> bytes:
        at = data.find(b"t301")
        if toward == "amplifier" and at >= 0 and not lost.is_set():
            lost.set()
            return data[:at] + data[data.index(b"\r", at) + 1 :]
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
    await chain.amplifier.status()
    await chain.rest(0.1)
    chain.between.delay = 0.0
    await chain.touch(rest=0.05)


async def disarmed_amid(chain: Chain) -> None:
    """It is disarmed while a finger is felt."""
    await chain.operate("arm")
    await chain.touch(1, rest=0.06)
    await chain.operate("disarm", rest=0.1)
    await chain.amplifier.status()
    await chain.touch()


async def strangers_set(chain: Chain) -> None:
    """A program that goes round the controller sends a silent set to a disarmed amplifier."""
    guard = Guard(GuardLimits(40.0, 500.0, 0.5), chain.amplifier.capabilities)
    await chain.rest(0.02)
    await chain.amplifier.status()
    with contextlib.suppress(CommandRefused):
        await chain.amplifier.apply(guard.silence(7, (0, 1), ramp=0.0))
    await chain.rest(0.02)


async def strangers_heartbeat(chain: Chain) -> None:
    """Another program feeds the watchdog while a finger is felt; on CAN it is the same host."""
    await chain.operate("arm")
    await chain.touch(1, rest=0.06)
    amplifier, own = chain.amplifier, chain.amplifier.session
    amplifier.session = own % 65535 + 1
    beating = asyncio.ensure_future(amplifier.heartbeat())
    await asyncio.sleep(0)
    amplifier.session = own
    with contextlib.suppress(CommandRefused):
        await beating
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
