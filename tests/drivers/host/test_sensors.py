"""Readings of sensors: whole ones, and replies that contradict themselves or the request."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from drivers.errors import CommandError, CommandRefused, FrameError
from drivers.host.amplifier import Sensor, measure_tones, read_sensors, start_reading
from drivers.protocol.definition import READING_STATES, UNKNOWN_PLACE, sensor_reading
from drivers.protocol.records import Values
from virtual_lines import MemoryLine, in_virtual_time

FREQUENCIES = [110.0, 173.5]
ROW = {"unit": 1, "channel": 255, "x": 1000, "y": 2000, "range": 512.0, "frequency_max": 20_000}
Alter = Callable[[str, Values], Values]


class Sensors:
    """Sensors of a far end, with a reading of theirs; alter: changes each reply."""

    def __init__(self, count: int, alter: Alter) -> None:
        self._count, self._alter = count, alter
        self._number = self._tones = 0
        self._reads = 0

    def handle(self, name: str, values: Values, now: float) -> Values:
        """Reply to a request."""
        return self._alter(name, self._reply(name, values))

    def _reply(self, name: str, values: Values) -> Values:
        if name == "GetSensors":
            rows = [ROW] * min(self._count - values["first"], 10)
            return {"all": self._count, "count": len(rows), "sensors": rows}
        if name == "Measure":
            self._number, self._tones = values["reading"], values["tones"]
        head = {"reading": self._number, "window_start": 0, "token": 0, "tones": self._tones}
        if name == "Measure":
            state = READING_STATES["RUNNING"]
            return {**head, "state": state, "window_left": 100, "count": 0, "sensors": []}
        count = min(self._count - values["first"], 16)
        tones = [{"amplitude": float(each + 1), "phase": -9000} for each in range(self._tones)]
        words: list[int] = []
        for _ in range(count):
            sensor_reading(self._tones).append(words, {"flags": 1, "tones": tones})
        done = {"state": READING_STATES["COMPLETE"], "window_left": 0}
        return {**head, **done, "count": count, "sensors": words}

    def changed(self, moment: float) -> None:
        """Nothing."""

    def forget(self) -> None:
        """Nothing."""


def unaltered(name: str, reply: Values) -> Values:
    """A reply as it should be."""
    return reply


def changed(which: str, name: str, reply: Values, **changes: Any) -> Values:
    """A reply with changes, if it is to this request."""
    return {**reply, **changes} if name == which else reply


async def opened(alter: Alter = unaltered, count: int = 20) -> MemoryLine:
    """A line with an amplifier, identified, that has sensors."""
    line = MemoryLine("serial", "a")
    line.far["a"].attach(Sensors(count, alter))
    await line.hosts["a"].open()
    return line


@in_virtual_time
async def test_sensors_and_their_tones_come_in_several_replies() -> None:
    """Twenty: ten descriptions and sixteen readings in a reply, in the units of the wire."""
    line = await opened()
    sensors = await read_sensors(line.hosts["a"])
    assert sensors == (Sensor("ACCELERATION", None, 0.1, 0.2, 512.0, 1000.0),) * 20
    reading = await measure_tones(line.hosts["a"], FREQUENCIES, 0.1)
    assert reading.state == "COMPLETE"
    assert [one.tones for one in reading.sensors] == [((1.0, -90.0), (2.0, -90.0))] * 20
    assert all(one.is_overloaded for one in reading.sensors)


@in_virtual_time
async def test_place_that_is_unknown_is_none() -> None:
    """As at the foot of a channel's actuator."""
    row = {**ROW, "channel": 1, "x": UNKNOWN_PLACE, "y": UNKNOWN_PLACE}
    line = await opened(partial(changed, "GetSensors", sensors=[row]), 1)
    (sensor,) = await read_sensors(line.hosts["a"])
    assert (sensor.channel, sensor.x, sensor.y) == (1, None, None)


@in_virtual_time
async def test_reading_of_another_host_is_not_taken_for_the_one_begun() -> None:
    """The reply to Measure, or to GetReading, is of another number."""
    for name in ("Measure", "GetReading"):

        def alter(request: str, reply: Values, name: str = name) -> Values:
            return changed(name, request, reply, reading=reply.get("reading", 0) % 65535 + 1)

        line = await opened(alter)
        with pytest.raises(CommandRefused, match="replaced"):
            await measure_tones(line.hosts["a"], FREQUENCIES, 0.1)


@pytest.mark.parametrize(
    "changes",
    [
        {"state": READING_STATES["RUNNING"]},
        {"count": 0, "sensors": []},
        {"count": 17},
        {"tones": 1},
        {"tones": 60_000},
    ],
    ids=["never ends", "no sensors", "too few words", "other tones", "absurd tones"],
)
@in_virtual_time
async def test_incomplete_reading_is_an_error(changes: dict[str, Any]) -> None:
    """A reading that never ends, or has other sensors or tones than were begun."""
    line = await opened(partial(changed, "GetReading", **changes))
    with pytest.raises(FrameError):
        await measure_tones(line.hosts["a"], FREQUENCIES, 0.1)


@in_virtual_time
async def test_tones_that_the_window_does_not_tell_apart_are_not_sent() -> None:
    """110 and 112 Hz need half a second; no tone and seventeen are none."""
    line = await opened()
    for frequencies in ([110.0, 112.0], [], [20.0 * each for each in range(1, 18)]):
        with pytest.raises(CommandError):
            await start_reading(line.hosts["a"], frequencies, 0.4)
    with pytest.raises(CommandError):
        await start_reading(line.hosts["a"], [110.0], 11.0)
