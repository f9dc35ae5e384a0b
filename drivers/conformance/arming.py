"""Checks of arming, sessions, and of what is refused without them."""

from collections.abc import Mapping

from drivers.conformance.check import driving
from drivers.conformance.findings import expect, expect_equal
from drivers.conformance.subject import NAMES, SLACK, Subject, flag, is_silent, layer
from drivers.protocol.records import Values
from drivers.protocol.table import QUANTITIES

_STATES = "protocol.md#states"
_OFF, _ENABLED = "SWITCH_ON_DISABLED", "OPERATION_ENABLED"


@driving(_STATES)
async def plays_nothing_disarmed(subject: Subject) -> None:
    """It plays nothing before it is armed."""
    subject.session = 1
    (part,) = subject.parts(layer(0, subject.tone()))
    await subject.refused("WRONG_STATE", "Set", **part)
    await subject.refused("WRONG_STATE", "Set", **{**part, "now": 0})
    await subject.refused("WRONG_STATE", "Commit", session=1, token=1)
    await subject.refused("WRONG_STATE", "Silence", session=1, ramp=0)
    status = await subject.expect_levels(why="while disarmed")
    expect_equal(NAMES[status["state"]], _OFF, "state after refused requests")
    expect_equal(flag(status, "high_voltage"), False, "high voltage while disarmed")
    expect_equal(
        (await subject.request("Ping", session=1))["state"], status["state"], "state, Ping"
    )


@driving(_STATES)
async def arming(subject: Subject) -> None:
    """It is silent once armed, with high voltage on, and forgets what was played and staged."""
    status = (await subject.arm()).values
    expect(is_silent(status), "levels after Arm", expected="0", seen=status["levels"])
    expect_equal(flag(status, "high_voltage"), True, "high voltage after Arm")
    expect_equal(flag(status, "interlock_open"), False, "interlock after Arm was carried out")
    expect_equal((status["token"], status["fault"]), (0, 0), "token, fault after Arm")
    await subject.play(layer(0, subject.tone()), token=40_000)
    staged = await subject.stage(layer(0, subject.tone()), token=40_001)
    await subject.request("Disarm", ramp=0)
    await subject.until(lambda each: NAMES[each["state"]] == _OFF, "disarming")
    status = (await subject.arm()).values
    expect_equal(status["token"], 0, "token after Arm")
    await subject.refused("BAD_TOKEN", "Commit", session=subject.session, token=staged)
    await subject.expect_levels(why="after Arm")
    # Older than 40 000, but the first of this session.
    await subject.play(layer(0, subject.tone()), token=39_999)
    await subject.expect_levels(1.0, why="first set of a session")


@driving(_STATES)
async def watchdog_ranges(subject: Subject) -> None:
    """It arms with its shortest and longest watchdog, and with none beyond."""
    low, high = subject.can["watchdog_min"], subject.can["watchdog_max"]
    outer = QUANTITIES["watchdog"]
    for time in {low - 1, high + 1, outer.minimum - 1, outer.maximum + 1, 0, 0xFFFF} - {low, high}:
        if not low <= time <= high:
            what = f"Arm with a watchdog of {time} ms"
            await subject.refused_words("BAD_VALUE", "Arm", [77, time], what=what)
    await subject.refused_words("BAD_VALUE", "Arm", [0, low], what="Arm with session 0")
    for time in (low, high):
        status = (await subject.arm(time / 1000)).values
        left = status["watchdog_left"]
        expect(time - 10 <= left <= time, "watchdog_left after Arm", expected=time, seen=left)
        await subject.request("Disarm", ramp=0)


@driving(_STATES)
async def arms_again(subject: Subject) -> None:
    """It takes the same Arm again as a restart of the watchdog with its time, and plays on."""
    await subject.arm(subject.can["watchdog_max"] / 1000)
    await subject.play(layer(0, subject.tone()))
    staged = await subject.stage(layer(0, subject.tone(0, 0.5)))
    low = subject.can["watchdog_min"]
    again = await subject.request("Arm", session=subject.session, watchdog=low)
    expect(
        low - 10 <= again.values["watchdog_left"] <= low,
        "watchdog_left after the same Arm with a shorter watchdog",
        expected=f"{low - 10} to {low}",
        seen=again.values["watchdog_left"],
    )
    maximum = subject.can["watchdog_max"]
    await subject.request("Arm", session=subject.session, watchdog=maximum)
    status = await subject.expect_levels(1.0, why="after the same Arm")
    expect_equal(status["token"], subject.token - 1, "token after the same Arm")
    await subject.commit(staged)
    await subject.expect_levels(0.5, why="set that was staged before the same Arm")


@driving("protocol.md#sessions-and-the-watchdog")
async def sessions(subject: Subject) -> None:
    """It obeys the session that armed it, of 16 bits, and no other; an ended one arms no more."""
    subject.client.session = 0x1233
    await subject.arm()
    await subject.play(layer(0, subject.tone()))
    staged = await subject.stage(layer(0, subject.tone(0, 0.5)))
    (part,) = subject.parts(layer(0, subject.tone(0, 0.25)))
    for other in (0x1235, 0x5634, 0x1256, 0xEDCB, 1):
        requests: Mapping[str, Values] = {
            "Set": part,
            "Commit": {"token": staged},
            "Silence": {"ramp": 0},
            "Ping": {},
            "Arm": {"watchdog": subject.can["watchdog_max"]},
        }
        for name, values in requests.items():
            await subject.refused("WRONG_SESSION", name, **{**values, "session": other})
    await subject.expect_levels(1.0, why="after requests of other sessions")
    await subject.refused_words("BAD_VALUE", "Ping", [0], what="Ping with session 0")
    ended = subject.session
    await subject.request("Disarm", ramp=0)
    await subject.until(lambda each: NAMES[each["state"]] == _OFF, "disarming")
    maximum = subject.can["watchdog_max"]
    await subject.refused("WRONG_SESSION", "Arm", session=ended, watchdog=maximum)
    await subject.arm()
    await subject.refused("WRONG_SESSION", "Set", **part)
    await subject.expect_levels(why="after a set of the session that ended")


@driving(_STATES)
async def arming_ends_fades(subject: Subject) -> None:
    """It is silent 5 ms after an Arm amid the fade of a Disarm."""
    await subject.arm()
    await subject.play(layer(0, subject.tone()))
    ramp = subject.can["ramp_max"]
    await subject.request("Disarm", ramp=ramp)
    armed = await subject.arm()
    when, _ = await subject.until(lambda each: not any(each["levels"]), "silence after Arm")
    latest = armed.when.latest + 0.005 + SLACK
    expect(
        when.earliest <= latest or ramp < 20,
        "silence after Arm amid a fade",
        expected="within 7 ms",
        seen=f"{1e3 * (when.earliest - armed.when.latest):.1f} ms",
    )
    await subject.play(layer(0, subject.tone()))
    await subject.expect_levels(1.0, why="after Arm amid a fade")
