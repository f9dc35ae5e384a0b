"""Checks of arming, sessions, and of what is refused without them."""

from drivers.conformance.check import driving
from drivers.conformance.expected import flag
from drivers.conformance.findings import expect_equal
from drivers.conformance.material import layer
from drivers.conformance.subject import Subject
from drivers.protocol.table import QUANTITIES

_STATES = "protocol.md#states"


@driving(_STATES)
async def plays_nothing_disarmed(subject: Subject) -> None:
    """It plays nothing before it is armed."""
    (part,) = subject.parts(subject.one(), token=1)
    for name, values in (
        ("Set", part),
        ("Set", {**part, "now": 0}),
        ("Commit", {"token": 1}),
        ("Silence", {"ramp": 0}),
    ):
        await subject.refused("WRONG_STATE", name, **{**values, "session": 1})
    await subject.status()
    await subject.request("Ping", session=1)


@driving(_STATES)
async def arming(subject: Subject) -> None:
    """It is silent once armed, with high voltage on, and forgets what was played and staged."""
    status = await subject.arm()
    expect_equal(flag(status.values, "interlock_open"), False, "interlock once armed")
    await subject.play(subject.one(), token=40_000)
    staged = await subject.stage(subject.one(), token=40_001)
    await subject.request("Disarm", ramp=0)
    await subject.settle()
    await subject.arm()
    await subject.refused("BAD_TOKEN", "Commit", session=subject.session, token=staged)
    await subject.status()
    # Older than 40 000, but the first of this session.
    await subject.play(subject.one(), token=39_999)
    await subject.status()


@driving(_STATES)
async def watchdog_ranges(subject: Subject) -> None:
    """It arms with its shortest and longest watchdog, and with none beyond."""
    low, high = subject.can["watchdog_min"], subject.can["watchdog_max"]
    outer = QUANTITIES["watchdog"]
    for time in (low - 1, high + 1, outer.minimum - 1, outer.maximum + 1, 0, 0xFFFF):
        if not low <= time <= high:
            await subject.refused("BAD_VALUE", "Arm", 77, time)
    await subject.refused("BAD_VALUE", "Arm", 0, low)
    for time in (low, high):
        await subject.arm(time / 1000)
        await subject.request("Disarm", ramp=0)


@driving(_STATES)
async def arms_again(subject: Subject) -> None:
    """It takes the same Arm again as a restart of the watchdog with its time, and plays on."""
    await subject.arm(subject.can["watchdog_max"] / 1000)
    await subject.play(subject.one())
    staged = await subject.stage(layer(0, subject.tone(0, 0.5)))
    for time in (subject.can["watchdog_min"], subject.can["watchdog_max"]):
        await subject.request("Arm", session=subject.session, watchdog=time)
    await subject.commit(staged)
    await subject.status()


@driving("protocol.md#sessions-and-the-watchdog")
async def sessions(subject: Subject) -> None:
    """It obeys the session that armed it, of 16 bits, and no other; an ended one arms no more."""
    subject.client.session = 0x1233
    await subject.arm()
    await subject.play(subject.one())
    staged, maximum = await subject.stage(subject.one()), subject.can["watchdog_max"]
    (part,) = subject.parts(layer(0, subject.tone(0, 0.25)))
    for other in (0x1235, 0x5634, 0x1256, 0xEDCB, 1):
        for name, values in (
            ("Set", part),
            ("Commit", {"token": staged}),
            ("Silence", {"ramp": 0}),
            ("Ping", {}),
            ("Arm", {"watchdog": maximum}),
        ):
            await subject.refused("WRONG_SESSION", name, **{**values, "session": other})
    await subject.status()
    await subject.refused("BAD_VALUE", "Ping", 0)
    ended = subject.session
    await subject.request("Disarm", ramp=0)
    await subject.settle()
    await subject.refused("WRONG_SESSION", "Arm", session=ended, watchdog=maximum)
    await subject.arm()
    await subject.refused("WRONG_SESSION", "Set", **part)
    await subject.status()


@driving(_STATES)
async def arming_ends_fades(subject: Subject) -> None:
    """It is silent 5 ms after an Arm amid the fade of a Disarm."""
    await subject.arm()
    await subject.play(subject.one())
    await subject.request("Disarm", ramp=subject.can["ramp_max"])
    await subject.arm()
    await subject.follow(0.02)
    await subject.play(subject.one())
    await subject.status()
