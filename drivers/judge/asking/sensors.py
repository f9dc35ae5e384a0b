"""Checks of what is measured: voltages and currents of channels, and tones at sensors."""

import asyncio
import math
from collections.abc import Sequence
from itertools import pairwise

from drivers.protocol.definition import NO_CHANNEL, READING_STATES, ahead, sensor_reading
from drivers.protocol.records import Record, Values
from era_haptics.lab.conformance.check import driving, reading
from era_haptics.lab.conformance.judge_client import (
    Answer,
    expect,
    expect_equal,
    expect_one_of,
    expect_within,
    layer,
    read_as,
    send,
)
from era_haptics.lab.conformance.subject import Subject
from era_haptics.lab.expected_amplifier import ROUNDED

_PLACE = "protocol.md#sensors"
_WINDOW = 100  # ms
_APART = 300  # steps of frequency between two tones: one and a half periods of the window
_LOW = 1  # steps of frequency: less than a period of the window
_STEADY = 1.5  # s; until a plate moves steadily
_ERROR, _LEAK, _ANGLE = 0.1, 0.1, 1000  # of an amplitude, of another tone; hundredths of degrees
_POLL = 0.002  # s
_LEAST = 1e-30  # of a range
_RUNNING = READING_STATES["RUNNING"]


@driving("protocol.md#messages")
async def measured(subject: Subject) -> None:
    """It measures voltage and current of every channel, armed or not, more where more plays."""
    subject.require("electrical")

    async def voltages() -> list[int]:
        rows = (await subject.request("GetMeasured"))["channels"]
        expect_equal(len(rows), len(subject.channels), "number of channels that are measured")
        return [each["channel_voltage"] for each in rows]

    silent = await voltages()
    await subject.arm()
    for channel in subject.channels:
        await subject.play(layer(0, subject.tone(channel)))
        await asyncio.sleep(0.05)
        playing = (await voltages())[channel]
        what = f"voltage of channel {channel} that plays"
        expect_within(playing, silent[channel] + 1, math.inf, what)


async def _described(subject: Subject, first: int = 0) -> list[Values]:
    """Read all descriptions of sensors from one on."""
    subject.require("sensors")
    found: list[Values] = []
    while True:
        shown = await subject.request("GetSensors", first=first + len(found))
        found += shown["sensors"]
        if first + len(found) >= shown["all"]:
            return found
        expect(bool(shown["sensors"]), "sensors from a number on", expected="some", seen="none")


@reading(_PLACE)
async def sensors(subject: Subject) -> None:
    """It describes its sensors, always alike, each once, of its own channels."""
    found = await _described(subject)
    expect_equal(await _described(subject, 1), found[1:], "sensors from the second on, read again")
    for number, one in enumerate(found):
        own = *subject.channels, NO_CHANNEL
        expect_one_of(one["channel"], own, f"channel of sensor {number}")
        expect_within(one["range"], _LEAST, math.inf, f"range of sensor {number}")
        expect(found.count(one) == 1, f"sensor {number}", expected="unlike others", seen=one)


def _request(number: int, *frequencies: int) -> Values:
    tones = {"tones": len(frequencies), "frequencies": [*frequencies]}
    return {"reading": number, "window": _WINDOW, **tones}


async def _start(subject: Subject, request: Values) -> Answer:
    """Begin a reading, which says of which set and when."""
    fed = await subject.ping()
    began = await subject.request("Measure", **request)
    seen = began["reading"], began["state"], began["token"]
    required = request["reading"], _RUNNING, subject.shown.token
    expect_equal(seen, required, "number, state, token of a reading that begins")
    low = began.when.earliest - fed.when.latest - ROUNDED
    high = began.when.latest - fed.when.earliest + ROUNDED
    since = ahead(began["window_start"], fed["clock"])
    expect_within(since, low, high, "window_start since the clock of a Status before")
    return began


async def _complete(subject: Subject, began: Answer, state: str = "COMPLETE") -> list[Values]:
    """Await the end of a reading at its time; return the values of every sensor."""
    window, is_running = _WINDOW / 1000, True
    while is_running:
        await asyncio.sleep(_POLL)
        shown = await subject.request("GetReading", first=0)
        left, is_running = shown["window_left"] / 1000, shown["state"] == _RUNNING
        low = max(window - (shown.when.latest - began.when.earliest) - ROUNDED, 0.0)
        high = max(window - (shown.when.earliest - began.when.latest) + ROUNDED, 0.0)
        expect_within(left, low, high, "window_left")
        expect(
            high > 0 or not is_running, "state after the window", expected="over", seen="running"
        )
    seen = shown["reading"], shown["state"]
    required = began["reading"], READING_STATES[state]
    expect_equal(seen, required, "number, state of a reading that is over")
    record, found = Record(*sensor_reading(shown["tones"]).fields), list[Values]()
    count = len(await _described(subject))
    while len(found) < count:
        shown, at = await subject.request("GetReading", first=len(found)), 0
        expect(shown["count"] > 0, "sensors of a reading", expected=count, seen=len(found))
        for _ in range(shown["count"]):
            row, at = read_as("sensors of a reading", record.read, shown["sensors"], at)
            found.append(row)
    return found


def _expect_turned(
    first: Sequence[Values], second: Sequence[Values], by: int, what: str, slack: int = _ANGLE
) -> None:
    """Compare the phases of two tones that were read [0.01 degrees]."""
    apart = (second[0]["phase"] - first[0]["phase"] - by + 18_000) % 36_000 - 18_000
    expect_within(apart + by, by - slack, by + slack, what)


async def _lead(subject: Subject, request: Values) -> None:
    """Play each channel at 0 and at 90 degrees: where it is loudest, the second tone leads."""
    (tone,), slack = request["frequencies"], _ANGLE + subject.can["phase_step"]
    for channel in subject.channels:
        found = []
        for phase in (0.0, 90.0):
            request = {**request, "reading": request["reading"] + 1}
            await subject.play(subject.one(subject.tone(channel, 1.0, phase, frequency=tone)))
            await subject.pause(_STEADY)
            found.append(await _complete(subject, await _start(subject, request)))
        heard = [[each["tones"] for each in rows] for rows in found]
        first, second = max(zip(*heard, strict=True), key=lambda each: each[0][0]["amplitude"])
        what = f"phase of channel {channel} at 90 degrees against 0"
        _expect_turned(first, second, 9_000, what, slack)


@driving(_PLACE)
async def readings(subject: Subject) -> None:
    """It reads tones at its sensors over a window by its clock, and says what disturbed it."""
    described = await _described(subject)
    highest = min([subject.highest] + [each["frequency_max"] for each in described])
    tone = min(max(subject.frequency, 400), highest - _APART)
    full, half = (subject.one(subject.tone(0, each, frequency=tone)) for each in (1.0, 0.5))
    await subject.arm()
    found = []
    for number, (one, others) in enumerate(((full, ()), (full, (_APART,)), (half, ())), 1):
        await subject.play(one)
        await subject.pause(_STEADY)
        for again in (0, 10):
            request = _request(number + again, tone, *(tone + each for each in others))
            began = await _start(subject, request)
            found.append(await _complete(subject, began))
    loudest = max(range(len(described)), key=lambda at: found[0][at]["tones"][0]["amplitude"])
    tones = [each[loudest]["tones"] for each in found]
    loud = tones[0][0]["amplitude"]
    expected = [*(loud,) * 4, *(loud / 2,) * 2]
    for shown, required in zip(tones, expected, strict=True):
        low, high = (1 - _ERROR) * required, (1 + _ERROR) * required
        expect_within(shown[0]["amplitude"], low, high, f"amplitude of sensor {loudest}")
        for other in shown[1:]:
            expect_within(other["amplitude"], 0, _LEAK * loud, "amplitude of a silent tone")
    for first, second in pairwise(tones):
        _expect_turned(first, second, 0, "phase against that read before")
    await _lead(subject, _request(15, tone))
    began = await _start(subject, _request(121, tone))
    await subject.play(full)
    for frequencies in ([_LOW], [tone, tone], [tone, tone + 1]):
        await subject.send(send("Measure", **_request(122, *frequencies), code="BAD_VALUE"))
    await _complete(subject, began, "DISTURBED")
