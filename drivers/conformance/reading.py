"""Checks that only read: who it is, what it can, and what it refuses."""

import math

from drivers.conformance.check import driving, reading
from drivers.conformance.findings import expect, expect_equal
from drivers.conformance.subject import NAMES, Subject, flag
from drivers.protocol.serial_payload import speaks
from drivers.protocol.table import (
    BY_NUMBER,
    FEATURES,
    MESSAGES,
    QUANTITIES,
    REACTION,
    VERSION,
)

_UNKNOWN = (19, 24, 29, 63)  # numbers of no message, below those of vendors
_RANGES = ("frequency", "watchdog", "envelope_step")
_TRIES = 20
_FEATURE_OF = {
    **{"GetMeasured": "electrical", "SetAddress": "address"},
    **{"GetSensors": "sensors", "Measure": "sensors", "GetReading": "sensors"},
}


@reading("protocol.md#messages")
async def identity(subject: Subject) -> None:
    """It says who it is, always the same, and that it speaks version 3."""
    first = subject.identity
    expect(speaks(first, VERSION), "versions", expected="bit 3 set", seen=first["versions"])
    for name in ("vendor", "product", "serial_number", "firmware"):
        expect(bool(first[name]), name, expected="a text", seen="none")
    expect_equal(await subject.client.hello(), first, "identity, read again")


@reading("protocol.md#messages")
async def capabilities(subject: Subject) -> None:
    """It states capabilities within their ranges, always the same."""
    can = subject.can
    for name, least in (("layers", 4), ("voices", 8), ("set_words", 512)):
        expect(can[name] >= least, name, expected=f"at least {least}", seen=can[name])
    for name in ("frequency_step", "level_step", "phase_step", "level_max", "slew"):
        expect(can[name] > 0, name, expected="above 0", seen=can[name])
    for name in _RANGES:
        low, high = can[f"{name}_min"], can[f"{name}_max"]
        expect(low <= high, f"{name}_min", expected=f"at most {high}", seen=low)
    for channel, one in enumerate(can["limits"]):
        low, high = one["frequency_min"], one["frequency_max"]
        is_within = can["frequency_min"] <= low <= high <= can["frequency_max"]
        what = f"frequencies of channel {channel}"
        expect(is_within, what, expected="within those of all", seen=(low, high))
        is_within = 0 < one["level_max"] <= can["level_max"]
        what = f"level_max of channel {channel}"
        expect(is_within, what, expected="above 0, within that of all", seen=one["level_max"])
    is_known = can["features"] < 1 << len(FEATURES)
    expect(is_known, "features", expected="defined bits", seen=f"{can['features']:#x}")
    expect_equal((await subject.request("GetCaps")).values, can, "capabilities, read again")


@reading("protocol.md#states")
async def starts_disarmed(subject: Subject) -> None:
    """It is disarmed and silent unless it was armed, and shows what it has only."""
    status = (await subject.request("GetStatus")).values
    expect(status["state"] != 4, "state before Arm", expected="disarmed", seen=NAMES[4])
    expect_equal(status["watchdog_left"], 0, "watchdog_left while disarmed")
    expect(not any(status["levels"]), "levels while disarmed", expected="0", seen=status["levels"])
    expect(not any(status["tokens"]), "tokens while disarmed", expected="0", seen=status["tokens"])
    expect(status["state"] in NAMES, "state", expected="0 to 7", seen=status["state"])
    if not subject.has("interlock"):
        expect_equal(flag(status, "interlock_open"), False, "interlock of one without")
    expect(status["flags"] < 8, "flags", expected="defined bits", seen=status["flags"])


@reading("protocol.md#times")
async def replies_in_time(subject: Subject) -> None:
    """It begins each reply within 10 ms."""
    for name in ("GetStatus", "GetCaps", "GetFaults"):
        fastest = math.inf
        for _ in range(_TRIES):
            when = (await subject.request(name)).when
            fastest = min(fastest, when.latest - when.earliest)
        maximum = REACTION + subject.client.transit
        expect(
            fastest <= maximum,
            f"fastest of {_TRIES} replies to {name}",
            expected=f"within {1e3 * maximum:.1f} ms",
            seen=f"{1e3 * fastest:.1f} ms",
        )


@reading("protocol.md#messages")
async def unknown_types(subject: Subject) -> None:
    """It refuses messages that it does not know, and those of what it does not have."""
    for number in _UNKNOWN:
        answer = await subject.client.exchange(number, ())
        expect_equal(answer.code, "UNKNOWN_TYPE", f"refusal of message {number}")
    for name, feature in _FEATURE_OF.items():
        if not subject.has(feature):
            words = _shortest(name)
            await subject.refused_words(
                "UNKNOWN_TYPE", name, words, what=f"{name} without {feature}"
            )


@driving("protocol.md#checks-in-this-order")
async def lengths(subject: Subject) -> None:
    """It refuses messages that are a word too short or too long."""
    for message in BY_NUMBER.values():
        words = _shortest(message.name)
        feature = _FEATURE_OF.get(message.name)
        if feature is not None and not subject.has(feature):
            continue
        for what, altered in (("short", words[:-1]), ("long", [*words, 0])):
            if altered == words or (message.name, what) == ("Set", "long"):
                continue
            text = f"{message.name}, a word too {what}"
            await subject.refused_words("BAD_LENGTH", message.name, altered, what=text)


@reading("protocol.md#messages")
async def reading_changes_nothing(subject: Subject) -> None:
    """It shows the achieved tones of every layer, none while disarmed, and its faults."""
    for number in subject.layers:
        achieved = (await subject.request("GetAchieved", layer=number)).values
        shown = achieved["token"], achieved["layer"], achieved["commands"]
        expect_equal(shown, (0, number, []), f"token, layer and commands of silent layer {number}")
    for number in range(len(subject.layers), 16):
        await subject.refused("BAD_VALUE", "GetAchieved", layer=number)
    before = (await subject.request("GetStatus")).values
    for name in ("GetFaults", "GetCaps", "GetStatus"):
        await subject.request(name)
    after = (await subject.request("GetStatus")).values
    for name in ("state", "fault", "latch", "token", "levels", "tokens"):
        expect_equal(after[name], before[name], f"{name} after reading")


@reading("protocol.md#messages")
async def ages_and_temperature(subject: Subject) -> None:
    """It states a temperature and a voltage in range, and faults that it knows."""
    faults = (await subject.request("GetFaults")).values["faults"]
    ages = [each["age"] for each in faults]
    expect_equal(ages, sorted(ages), "ages of faults, the newest first")
    for each in faults:
        is_known = each["channel"] < len(subject.channels) or each["channel"] == 255
        expect(is_known, "channel of a fault", expected="one of its own", seen=each["channel"])


@reading("serial.md#receiving", "serial")
async def hello_for_ever(subject: Subject) -> None:
    """It answers a Hello of any version and length, and no other version of anything else."""
    client = subject.client
    for payload, version in ((b"", 3), (b"\1\2\3", 0), (b"\1", 77), (b"", 2)):
        shown = await client.identity(payload, version)  # type: ignore[attr-defined]
        expect_equal(shown, subject.identity, f"identity by a Hello of version {version}")
    for version in (0, 2, 4, 255):
        number = MESSAGES["GetStatus"].number
        answer = await client.exchange_payload(number, b"", version)  # type: ignore[attr-defined]
        expect_equal(
            answer.code, "UNSUPPORTED_VERSION", f"refusal of a request of version {version}"
        )
    answer = await client.exchange_payload(12, b"\1\0\0", VERSION)  # type: ignore[attr-defined]
    expect_equal(answer.code, "BAD_LENGTH", "refusal of half a word")


def _shortest(name: str) -> list[int]:
    """Return the words of a request that is right but for the state."""
    values = {
        **{"session": 1, "watchdog": 250, "ramp": 5, "token": 1, "index": 0, "parts": 1},
        **{"now": 0, "stream": [], "latch": 0, "layer": 0, "address": 9, "serial_number": "?"},
        **{"first": 0, "reading": 1, "window": 1000, "tones": 1},
        "frequencies": [QUANTITIES["frequency"].to_wire(100.0)],
    }
    return MESSAGES[name].request.pack(values)
