"""Opening and arming: all amplifiers of a group are armed by this host, or none stays armed.

An amplifier that was exchanged, has restarted or is driven by another host is never armed.
"""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from drivers.errors import CommandRefused, DriverError, LinkDegraded, LinkError, Preempted
from drivers.host.set_admission import StagedSet
from drivers.protocol.definition import FEATURES, MESSAGES
from drivers.protocol.records import Values
from drivers.wires.can_frames import CanFrame, pack_frames, segments
from registry import threads
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from tests.drivers.host.group_on_lines import (
    HALF,
    SILENT,
    Rig,
    begin,
    connect,
    intercept,
    layer,
    losing,
    lost,
    on_wires,
    refuse,
    tone,
)


@on_wires("serial")
async def test_session_is_the_same_on_one_line_only(wire: str) -> None:
    """A broadcast commit reaches all amplifiers of its line, and plays on no other line."""
    rig = await connect("ab", "c", wire=wire)

    await rig.play(0.5)

    await asyncio.sleep(0.01)
    assert rig.levels == dict.fromkeys("abc", HALF)
    assert rig.far["a"].session == rig.far["b"].session
    assert rig.far["a"].session != rig.far["c"].session


@on_wires()
async def test_opening_disarms_an_amplifier_that_an_earlier_host_armed(wire: str) -> None:
    """It plays on until it is opened."""
    rig = await connect("a", wire=wire, watchdog=2.0)
    await rig.play(0.5)
    await asyncio.sleep(0.02)
    assert rig.levels == {"a": HALF}

    await rig.hosts["a"].open()

    assert rig.levels == {"a": SILENT}
    assert rig.far["a"].state == "SWITCH_ON_DISABLED"


@on_wires("serial")
async def test_arming_again_stops_an_amplifier_that_cannot_be_disarmed(wire: str) -> None:
    """One has tripped, so the other must be disarmed first; it ignores that."""
    rig = await connect("a", "b", wire=wire)
    await rig.play(0.5)
    intercept(rig.far["a"], "Disarm", lambda _: rig.far["a"].status(threads.now()))
    rig.far["b"].trip("OVER_VOLTAGE", threads.now())

    with pytest.raises(DriverError):
        await rig.group.arm()

    assert rig.levels == {"a": SILENT, "b": SILENT}


@on_wires("serial")
async def test_machine_that_slept_while_arming_arms_nothing(wire: str) -> None:
    """It wakes half a minute later, when whoever asked for it may have gone."""
    rig = await connect("a", wire=wire, is_armed=False)
    arming = await begin(rig.group.arm())
    await asyncio.sleep(0.001)

    rig.line.loop.now += 30.0

    with pytest.raises(DriverError):
        await arming
    assert rig.far["a"].state == "SWITCH_ON_DISABLED"


@on_wires()
async def test_stop_at_the_moment_of_arming_prevents_it(wire: str) -> None:
    """The stop comes between the call and its first request, so that no Arm is sent."""
    rig = await connect("a", wire=wire, is_armed=False)
    rig.watch()
    arming = await begin(rig.group.arm())

    await rig.group.stop()

    with pytest.raises(DriverError):
        await arming
    assert "a Arm" not in rig.requests()


@on_wires()
async def test_stop_during_the_identification_leaves_the_amplifier_disarmed(wire: str) -> None:
    """Arm waits 20 ms for a second reply to Hello; a stop comes first."""
    rig = await connect("a", wire=wire, is_armed=False)
    host = rig.hosts["a"]
    arming = await begin(host.arm(77))
    await asyncio.sleep(0.01)

    await host.stop()
    await host.clear()

    with pytest.raises(Preempted):
        await arming
    assert rig.far["a"].state == "SWITCH_ON_DISABLED"


@on_wires()
async def test_mute_amplifier_leaves_the_others_disarmed_without_a_fault(wire: str) -> None:
    """Arming fails within 0.6 s, before the watchdogs of the armed amplifiers expire."""
    rig = await connect("a", "b", wire=wire, is_armed=False)
    rig.lines[1].outward = lost

    async with asyncio.timeout(0.6):
        with pytest.raises(LinkError):
            await rig.group.arm()

    assert rig.levels == {"a": SILENT, "b": SILENT}
    assert rig.far["a"].fault == "NONE"


@on_wires("serial")
async def test_amplifier_that_missed_only_its_arming_can_be_armed_next(wire: str) -> None:
    """Stopped long ago, it counts as lost, but replies to the disarm that follows immediately."""
    rig = await connect("a", "b", wire=wire)
    await rig.group.stop()
    await rig.group.clear()
    await asyncio.sleep(1.0)
    rig.line.inward = losing("Hello", count=3)
    with pytest.raises(LinkDegraded):
        await rig.group.arm()

    await rig.group.arm()

    assert rig.group.is_armed


@on_wires("serial")
async def test_amplifier_that_was_busy_after_a_lost_reply_does_not_stay_armed(wire: str) -> None:
    """The first attempt armed it, and the repeated ones are refused: it is disarmed."""
    rig = await connect("a", wire=wire, is_armed=False)
    rig.line.outward = losing("Arm", count=2)  # its event, and the reply
    refuse(rig.far["a"], "Arm", "BUSY", after=1)
    rig.watch()

    with pytest.raises(CommandRefused):
        await rig.group.arm()

    assert 2 <= rig.requests().count("a Arm") <= 3
    assert rig.far["a"].state == "SWITCH_ON_DISABLED"


@on_wires("serial")
async def test_amplifier_that_trips_as_it_is_armed_leaves_none_armed(wire: str) -> None:
    """Its reply to Arm shows the fault, and the amplifier that was armed is disarmed."""
    rig = await connect("b", "a", wire=wire, is_armed=False)
    tripped = rig.far["a"]

    def trip(own: Callable[[], Values]) -> Values:
        own()
        tripped.trip("OVER_VOLTAGE", threads.now())
        return tripped.status(threads.now())

    intercept(tripped, "Arm", trip)

    with pytest.raises(CommandRefused, match="OVER_VOLTAGE"):
        await rig.group.arm()

    assert not rig.group.is_armed
    assert rig.far["b"].state == "SWITCH_ON_DISABLED"


@on_wires()
async def test_restarted_amplifier_is_armed_with_its_new_limits(wire: str) -> None:
    """It plays at most 0.3 since: 0.4 is refused here, before anything is sent."""
    rig = await connect("a", wire=wire, is_armed=False)
    rig.far["a"].capabilities["level_max"] = 3000
    rig.far["a"].restart(threads.now())
    if wire == "can":
        rig.line.boot(1)
    await rig.group.arm()
    rig.watch()

    with pytest.raises(CommandRefused):
        await rig.play(0.4)

    assert rig.requests() == []
    await rig.play(0.3)


@on_wires()
async def test_unidentified_amplifier_plays_nothing_but_can_be_silenced(wire: str) -> None:
    """A stop that finds its line closed forgets the identity; a refusal names the amplifier."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)

    rig.hosts["a"].identification.forget()

    planned = {"a": StagedSet([layer(0, tone(0.5))])}
    refusal = rig.group.sets.refusal_of(planned)
    assert "a must be identified" in str(refusal)
    with pytest.raises(CommandRefused, match="a must be identified"):
        await rig.play(0.4)
    await rig.group.silence(0.005)
    await asyncio.sleep(0.01)
    assert rig.levels == {"a": SILENT}


ANOTHER_HOST = {"session": 4242, "watchdog": 2000, "shift": 0}
"""How another host arms an amplifier."""


def arm_by_another_host(amplifier: SimulatedAmplifier) -> None:
    """Have another host arm an amplifier."""
    amplifier.handle("Arm", ANOTHER_HOST, threads.now())


def hear_another_host(rig: Rig, name: str) -> None:
    """Let another host's request to node 1 arrive on the first line, of CAN."""
    data = segments(99, MESSAGES[name].number, (4242, 250))
    rig.line.line.received(pack_frames(CanFrame(0x201, part) for part in data))


@on_wires("serial", "can", "tcp")
async def test_failed_arming_leaves_the_amplifier_of_another_host_armed(wire: str) -> None:
    """It replies at the address of an amplifier of the group, with another serial number."""
    rig = await connect("ab", wire=wire)
    await rig.group.disarm()
    rig.far["b"].identity["serial_number"] = "OTHER"
    arm_by_another_host(rig.far["b"])

    with pytest.raises(DriverError):
        await rig.group.arm()
    await rig.group.close()

    assert rig.far["a"].state == "SWITCH_ON_DISABLED"
    assert rig.far["b"].state == "OPERATION_ENABLED"


@on_wires()
async def test_exchanged_amplifier_is_not_armed(wire: str) -> None:
    """It was exchanged while switched off: its serial number differs."""
    rig = await connect("a", wire=wire, is_armed=False)
    rig.far["a"].identity["serial_number"] = "SIM-other"

    with pytest.raises(LinkError):
        await rig.group.arm()

    assert rig.far["a"].state == "SWITCH_ON_DISABLED"
    assert await rig.stop() == {"a": False}


@on_wires("can")
async def test_amplifier_that_another_host_drives_is_armed_only_after_it(wire: str) -> None:
    """Nothing is sent while its frames are heard; 2.1 s after they ended it is armed."""
    rig = await connect("a", wire=wire, is_armed=False)
    amplifier = rig.far["a"]
    arm_by_another_host(amplifier)
    hear_another_host(rig, "Ping")
    rig.watch()

    with pytest.raises(LinkError):
        await rig.group.arm()
    assert rig.requests() == []
    assert amplifier.state == "OPERATION_ENABLED"

    amplifier.handle("Disarm", {"ramp": 0}, threads.now())
    await asyncio.sleep(2.1)
    await rig.group.arm()
    assert amplifier.session not in (0, ANOTHER_HOST["session"])


@on_wires("can")
async def test_second_host_stops_an_armed_amplifier(wire: str) -> None:
    """The next heartbeat is not sent, and the amplifier is stopped."""
    rig = await connect("a", wire=wire)
    rig.watch()
    hear_another_host(rig, "Arm")

    with pytest.raises(LinkError):
        await rig.group.beat()

    assert not rig.group.is_armed
    assert rig.far["a"].state == "QUICK_STOP_ACTIVE"
    assert "a Ping" not in rig.requests()


@on_wires("can")
async def test_another_host_is_heard_while_opening(wire: str) -> None:
    """Its frames reveal it even if the watchdog has not been seen to rise."""
    rig = await connect("a", wire=wire, is_armed=False)
    arm_by_another_host(rig.far["a"])
    opening = await begin(rig.hosts["a"].open())
    await asyncio.sleep(0.1)

    hear_another_host(rig, "Ping")

    with pytest.raises(LinkError):
        await opening
    assert rig.far["a"].state == "OPERATION_ENABLED"


@on_wires()
async def test_opening_leaves_an_amplifier_that_another_host_feeds(wire: str) -> None:
    """Its heartbeats raise the watchdog; without them the amplifier is taken over."""
    rig = await connect("a", wire=wire, is_armed=False)
    amplifier = rig.far["a"]
    arm_by_another_host(amplifier)

    async def feed() -> None:
        while True:
            await asyncio.sleep(0.07)
            amplifier.handle("Ping", {"session": 4242, "rate": 0}, threads.now())

    feeding = await begin(feed())
    with pytest.raises(LinkError):
        await rig.hosts["a"].open()
    assert amplifier.state == "OPERATION_ENABLED"

    feeding.cancel()
    await rig.hosts["a"].open()
    assert amplifier.state == "SWITCH_ON_DISABLED"


@pytest.mark.parametrize(
    ("identity", "error"),
    [
        ({"versions": 6}, LinkError),
        ({"serial_number": "SIM-b"}, LinkError),
        ({"vendor": "vendor\n"}, DriverError),
        ({"vendor": "a\x1b[2J"}, DriverError),
    ],
    ids=["version", "serial number", "line feed", "escape sequence"],
)
@on_wires()
async def test_amplifier_with_an_unexpected_identity_is_not_opened(
    wire: str, identity: dict[str, Any], error: type[Exception]
) -> None:
    """A protocol version 2, another serial number, or a name that could rewrite a terminal."""
    rig = await connect("a", wire=wire, is_armed=False)
    amplifier = rig.far["a"]
    original = dict(amplifier.identity)
    amplifier.identity.update(identity)

    with pytest.raises(error):
        await rig.hosts["a"].open()

    amplifier.identity.update(original)
    await rig.hosts["a"].open()


@on_wires()
async def test_full_level_must_have_the_kind_that_the_rig_states(wire: str) -> None:
    """A linear amplifier when the rig has a stiff source, and the other way around."""
    rig = await connect("a", wire=wire, is_armed=False)
    host = rig.hosts["a"]

    host.identification.is_output = True
    with pytest.raises(LinkError, match="full level"):
        await host.open()

    rig.far["a"].capabilities["features"] |= 1 << FEATURES["output"]
    await host.open()
    host.identification.is_output = False
    with pytest.raises(LinkError, match="full level"):
        await host.open()
