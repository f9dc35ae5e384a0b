"""Replies to requests for sensors that contradict themselves or the request."""

import asyncio
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import pytest

from drivers.errors import CommandRefused, FrameError
from drivers.link.link import ReplyT
from drivers.protocol.messages import (
    Capabilities,
    GetReading,
    GetSensors,
    Measure,
    Reading,
    ReadingState,
    Reply,
    Request,
    Sensor,
    SensorList,
    SensorReading,
    SensorUnit,
    ToneReading,
)
from drivers.sensor_client import SensorClient
from vendor_pages import CAPABILITIES
from virtual_loop import run_virtual

SENSOR = Sensor(SensorUnit.ACCELERATION, None, 0.1, 0.2, 512.0, 1000.0)
TONE = ToneReading(1.0, 0.0)
Alter = Callable[[Request, Any], Reply]


class ScriptedClient(SensorClient):
    """Two sensors and a reading of theirs, each reply altered by the test."""

    def __init__(self, alter: Alter, count: int = 2) -> None:
        self._alter = alter
        self._sensors = (SENSOR,) * count
        self._measure = Measure(0, 0.0, ())
        self._end = 0.0
        self.requests: list[Request] = []

    @property
    def capabilities(self) -> Capabilities:
        return CAPABILITIES

    async def _request(
        self, request: Request, *, expect: type[ReplyT], timeout: float | None = None
    ) -> ReplyT:
        self.requests.append(request)
        return cast("ReplyT", self._alter(request, self._reply(request)))

    def _reply(self, request: Request) -> Reply:
        now = asyncio.get_running_loop().time()
        if isinstance(request, GetSensors):
            return SensorList(len(self._sensors), self._sensors[request.first :])
        if isinstance(request, Measure):
            self._measure, self._end = request, now + request.window
        tones = len(self._measure.frequencies)
        left = self._end - now
        running = Reading(self._measure.number, ReadingState.RUNNING, left, tone_count=tones)
        if left > 0:
            return running
        each = (SensorReading((TONE,) * tones),) * len(self._sensors)
        first = request.first if isinstance(request, GetReading) else 0
        return replace(running, state=ReadingState.COMPLETE, left=0.0, sensors=each[first:])


def unaltered(request: Request, reply: Reply) -> Reply:
    """A reply as it should be."""
    return reply


def of_readings(**changes: Any) -> Alter:
    """Alter what GetReading returns."""

    def alter(request: Request, reply: Any) -> Reply:
        return replace(reply, **changes) if isinstance(request, GetReading) else reply

    return alter


def test_reading_is_whole_if_nothing_is_wrong() -> None:
    """The replies that the other tests alter are good ones."""
    client = ScriptedClient(unaltered)
    whole = run_virtual(client.measure([110.0, 173.5], 0.1))
    assert whole.state is ReadingState.COMPLETE
    assert [len(one.tones) for one in whole.sensors] == [2, 2]


def test_reading_of_another_host_is_not_taken_for_the_one_begun() -> None:
    """The reply to Measure is of another number, as where two hosts begin at once over CAN."""

    def alter(request: Request, reply: Any) -> Reply:
        is_begun = isinstance(request, Measure)
        return replace(reply, number=reply.number % 65535 + 1) if is_begun else reply

    client = ScriptedClient(alter)
    with pytest.raises(CommandRefused, match="replaced"):
        run_virtual(client.start_reading([110.0], 0.1))


@pytest.mark.parametrize(
    "changes",
    [
        {"state": ReadingState.RUNNING, "left": 0.0},
        {"sensors": ()},
        {"sensors": (SensorReading((TONE,)),) * 3},
        {"sensors": (SensorReading(()),) * 2},
        {"tone_count": 2},
    ],
    ids=["never ends", "no sensors", "too many sensors", "no tones", "too many tones"],
)
def test_incomplete_reading_is_an_error(changes: dict[str, Any]) -> None:
    """A reading that never ends, or has other sensors or tones than were begun."""
    client = ScriptedClient(of_readings(**changes))
    with pytest.raises(FrameError):
        run_virtual(client.measure([110.0], 0.1))


def test_more_sensors_than_counted_are_an_error() -> None:
    """A list that holds more than the number of all."""

    def alter(request: Request, reply: Any) -> Reply:
        return replace(reply, count=1)

    client = ScriptedClient(alter)
    with pytest.raises(FrameError):
        run_virtual(client.sensors())


def test_as_many_sensors_as_the_protocol_counts() -> None:
    """From the 32nd on there are none, which is not asked for: it would be out of range."""
    client = ScriptedClient(unaltered, count=32)
    assert len(run_virtual(client.sensors())) == 32
    assert run_virtual(client.sensors(31)) == (SENSOR,)
    client.requests.clear()
    assert run_virtual(client.sensors(32)) == ()
    assert not client.requests
