"""Checks of identity, capabilities and readings."""

import asyncio
import math

from drivers.protocol.definition import (
    ENABLED,
    NO_CHANNEL,
    STATES,
    STATUS_FLAGS,
    has_flag,
)
from era_haptics.lab.conformance.check import driving, reading
from era_haptics.lab.conformance.judge_client import JudgeClient
from era_haptics.lab.conformance.outcomes import (
    AlreadyArmed,
    expect_equal,
    expect_one_of,
    expect_within,
    verify,
)
from era_haptics.lab.conformance.request_rows import layer, send
from era_haptics.lab.conformance.run import greeted
from era_haptics.lab.conformance.subject import Subject

_MAX_LAYERS = 16  # that a layer's number can name
_MEASURING_TIME = 0.05  # s; at least one period of the usual frequency


@reading("protocol.md#identity-and-capabilities", greets=True)
async def identity(client: JudgeClient) -> None:
    """Hello, sent twice: the same identity with all four texts, and version 4 supported.

    Return constant texts for vendor, product, serial number and firmware, and set bit 4 of
    versions.
    """
    identity = await greeted(client)
    for name in ("vendor", "product", "serial_number", "firmware"):
        verify(bool(identity[name]), name, expected="a text", actual="none")
    expect_equal(await client.hello(), identity, "identity, read a second time")


@reading("protocol.md#identity-and-capabilities")
async def capabilities(subject: Subject) -> None:
    """GetCaps, sent twice: the same capabilities, each within its range.

    Correct the number named above. Checks that need this capability are not run until it is right.
    """
    wrong = subject.can.wrong.items()
    required = "; ".join(f"{name} {required}" for name, (required, _) in wrong)
    stated = "; ".join(f"{name} {stated}" for name, (_, stated) in wrong)
    expect_equal(stated, required, "capabilities")
    await subject.request("GetCaps")


@reading("protocol.md#states")
async def starts_disarmed(subject: Subject) -> None:
    """GetStatus before Arm: disarmed and silent, flags of stated features only.

    Power up in SWITCH_ON_DISABLED, and set interlock_open only if you state the feature interlock.
    If another host has armed the amplifier, stop that host first.
    """
    status = (await subject.request("GetStatus")).values
    if status["state"] == ENABLED:
        raise AlreadyArmed("state before Arm", expected="disarmed", actual="OPERATION_ENABLED")
    disarmed = [number for number in STATES.values() if number != ENABLED]
    expect_one_of(status["state"], disarmed, "state before Arm")
    is_open = has_flag(status, "interlock_open") and not subject.has("interlock")
    expect_equal(is_open, False, "interlock_open without the feature interlock")
    expect_within(status["flags"], 0, (1 << len(STATUS_FLAGS)) - 1, "flags")


@reading("protocol.md#readings")
async def reading_changes_nothing(subject: Subject) -> None:
    """GetAchieved while disarmed: no command in any layer, BAD_VALUE beyond the last layer.

    For a layer that plays nothing, return its number and 0 in every other field. In GetFaults, name
    a channel that exists, or 255.
    """
    for number in range(len(subject.layers), _MAX_LAYERS):
        await subject.run([send("GetAchieved", layer=number, code="BAD_VALUE")])
    for number in subject.layers:
        await subject.run([send("GetAchieved", layer=number)])
    channels = *subject.channels, NO_CHANNEL
    reply = await subject.request("GetFaults")
    for fault in reply["faults"]:
        expect_one_of(fault["channel"], channels, "channel of a listed fault")
    await subject.status()


@driving("protocol.md#readings")
async def measured(subject: Subject) -> None:
    """GetMeasured: a row for every channel, more voltage on a channel that plays.

    Measure rms values over at least one period, on every channel, armed or not.
    """
    subject.require("electrical")
    silent_voltages = await _voltages(subject)
    await subject.arm()
    for channel in subject.channels:
        await subject.play(layer(0, subject.tone(channel)))
        await asyncio.sleep(_MEASURING_TIME)
        voltages = await _voltages(subject)
        lowest = silent_voltages[channel] + 1
        quantity = f"voltage of channel {channel} while it plays"
        expect_within(voltages[channel], lowest, math.inf, quantity)


async def _voltages(subject: Subject) -> list[int]:
    """Return the measured voltage of each channel."""
    rows = (await subject.request("GetMeasured"))["channels"]
    expect_equal(len(rows), len(subject.channels), "number of measured channels")
    return [row["channel_voltage"] for row in rows]
