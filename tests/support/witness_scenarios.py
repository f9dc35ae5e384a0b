"""What is played before the witness: an ordinary day, and days on which something is wrong."""

import hand_written as hand
from model.vibration.excitation import Tone
from set_table import STROKE
from witnessed_chain import ALONE, Scene


async def day(chain: Scene) -> None:
    """Touches, a neighbour, a lift, a stop amid a touch, clearing, arming, disarming."""
    await chain.operate("arm", rest=0.12)
    await chain.touch(1, rest=0.1)
    await chain.touch(1, 2, rest=0.12)
    await chain.touch(1, rest=0.05)
    await chain.touch(rest=0.1)
    await chain.touch(1, rest=0.1)
    await chain.touch(rest=0.1)
    await chain.touch(3, rest=0.1)
    await chain.operate("stop", rest=0.1)
    await chain.touch()
    await chain.operate("clear")
    await chain.operate("arm")
    await chain.touch(4, rest=0.06)
    await chain.operate("disarm", rest=0.1)
    await chain.touch()


async def hasty(chain: Scene) -> None:
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


async def hung(chain: Scene) -> None:
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


async def source_dies(chain: Scene) -> None:
    """A finger beside the plate is none; the source of touches dies with a finger down."""
    await chain.operate("arm", rest=0.05)
    chain.touch_beside()
    await chain.rest(0.1)
    await chain.touch(1, rest=0.1)
    await chain.fall_silent()
    await chain.rest(0.1)


async def slow(chain: Scene) -> None:
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


async def too_much(chain: Scene) -> None:
    """The table asks for more than full level on one ERA, 620 Hz, or is damaged: NaN."""
    await chain.operate("arm")
    for tone in ((150.0, 0.7, 0.0), (620.0, 0.4, 0.0), (150.0, 0.4, float("nan"))):
        frequency, level, phase = tone
        chain.table.excitation = {**ALONE, "NE": Tone(frequency, level * STROKE, phase)}
        await chain.touch(1, answerable=False)
        chain.witness.expect(None)
        await chain.rest(0.1)
        await chain.touch(rest=0.05)


async def arc(chain: Scene) -> None:
    """An amplifier trips amid a touch, is asked for its faults, cleared and identified again."""
    await chain.operate("arm")
    await chain.touch(1, rest=0.06)
    chain.trip()
    for _ in range(5):
        await chain.rest(0.02)
        await chain.amplifier.read_status()
    await chain.amplifier.request("GetFaults", {})
    await chain.touch(rest=0.1)
    await chain.operate("clear", rest=0.05)
    await chain.amplifier.identify()
    chain.trip()
    await chain.amplifier.request("GetFaults", {})


async def stranger(chain: Scene) -> None:
    """Another program sends a silent set while disarmed, later a heartbeat of its own session."""
    await chain.rest(0.1)
    chain.inject(hand.frame(hand.SET, hand.part(7, hand.layer(0), now=True), sequence=999))
    await chain.rest(0.01)
    await chain.operate("arm", rest=0.05)
    await chain.touch(1, rest=0.06)
    own = chain.amplifier.session
    chain.inject(hand.frame(hand.PING, (own % 65535 + 1,), sequence=999))
    await chain.rest(0.01)
    await chain.touch(rest=0.05)
