"""What is played before the witness: an ordinary day, and days on which something is wrong."""

import contextlib

import hand_written as hand
from drivers.by_hand import reaching
from drivers.errors import CommandRefused
from drivers.protocol.sets import LayerSet, pack_layers, parts
from model.vibration.excitation import Tone
from witnessed_chain import ALONE, STROKE, Chain


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
    await chain.operate("disarm", rest=0.1)
    await chain.touch()


async def hasty(chain: Chain) -> None:
    """Other fingers touch every 4 ms, within the ramp of a pattern; then all is opened again."""
    await chain.operate("arm", rest=0.12)
    for _ in range(5):
        await chain.touch(1, rest=0.004)
        await chain.touch(1, 2, rest=0.004)
    await chain.rest(0.1)
    await chain.touch(rest=0.06)
    await chain.reopen()
    await chain.operate("arm")
    await chain.touch(1, rest=0.06)
    await chain.touch(rest=0.05)


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
    """A finger beside the plate is none; the source of touches dies with a finger down."""
    await chain.operate("arm", rest=0.05)
    chain.touch_beside()
    await chain.rest(0.1)
    await chain.touch(1, rest=0.1)
    await chain.fall_silent()
    await chain.rest(0.1)


async def slow(chain: Chain) -> None:
    """The last finger is lifted, then an amplifier is stopped, each before a late reply."""
    await chain.operate("arm", rest=0.02)
    chain.delay = 0.025
    await chain.touch(1, rest=0.001)
    await chain.touch(rest=0.05)
    await chain.touch(1, rest=0.001)
    await chain.operate("stop")
    await chain.touch(rest=0.05)
    chain.delay = 0.0
    await chain.rest(0.05)


async def too_much(chain: Chain) -> None:
    """The table asks for more than full level on one ERA, 620 Hz, or is damaged: NaN."""
    await chain.operate("arm")
    for tone in ((150.0, 0.7, 0.0), (620.0, 0.4, 0.0), (150.0, 0.4, float("nan"))):
        frequency, level, phase = tone
        chain.table.alone = {**ALONE, "NE": Tone(frequency, level * STROKE, phase)}
        await chain.touch(1, answerable=False)
        chain.witness.expect(None)
        await chain.rest(0.1)
        await chain.touch(rest=0.05)


async def arc(chain: Chain) -> None:
    """An amplifier trips amid a touch, is asked for its faults, cleared and identified again."""
    await chain.operate("arm")
    await chain.touch(1, rest=0.06)
    chain.trip()
    for _ in range(5):
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
    stop = bytearray(hand.frame(hand.STOP, (5,), sequence=999))
    stop[-4] = stop[-4] ^ 0x55 or 1  # another checksum, without a zero byte
    chain.inject(bytes(stop))
    await chain.rest(0.1)
    chain.disturb(False)
    await chain.touch(rest=0.05)


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
