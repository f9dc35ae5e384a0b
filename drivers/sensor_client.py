"""Requests to the sensors of an amplifier: what they are, readings of tones, raw samples."""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

from drivers import clock
from drivers.errors import CommandError, CommandRefused, FrameError
from drivers.link.link import ReplyT
from drivers.link.refusals import PROTOCOL_VIOLATION
from drivers.protocol.definition import PROTOCOL, random_reading
from drivers.protocol.messages import (
    Capabilities,
    Feature,
    GetBlock,
    GetReading,
    GetSensors,
    Measure,
    Reading,
    ReadingState,
    Request,
    SampleBlock,
    Sensor,
    SensorList,
)

_MARGIN = 0.002  # s; of the amplifier's clock
_MAX_OVERDUE = 2.0  # s; after the end of the window: an emulator stands still meanwhile
_ROUNDING = 1e-6  # periods


class SensorClient(ABC):
    """Reads the sensors of an amplifier by its requests.

    Nothing here needs a session, feeds the watchdog, or changes what plays.
    """

    @property
    @abstractmethod
    def capabilities(self) -> Capabilities:
        """Its capabilities; known once open."""

    @abstractmethod
    async def _request(
        self, request: Request, *, expect: type[ReplyT], timeout: float | None = None
    ) -> ReplyT:
        """Send a request, and return its reply of the expected type."""

    async def sensors(self, first: int = 0) -> tuple[Sensor, ...]:
        """Read what its sensors measure, and where, from one on; empty if it has none."""
        if Feature.SENSORS not in self.capabilities.features:
            return ()
        found: list[Sensor] = []
        while first + len(found) <= PROTOCOL.quantities.sensor.maximum:
            listed = await self._request(GetSensors(first + len(found)), expect=SensorList)
            found += listed.sensors
            if listed.sensors and first + len(found) > listed.count:
                raise FrameError(
                    f"sensors from {first} on must be of {listed.count}, got {len(found)}; "
                    f"{PROTOCOL_VIOLATION}"
                )
            if first + len(found) >= listed.count or not listed.sensors:
                break
        return tuple(found)

    async def start_reading(self, frequencies: Sequence[float], window: float) -> Reading:
        """Begin to measure tones [Hz] at all sensors, over a window [s] from now on.

        Raises CommandRefused for frequencies that the window does not tell apart, or beyond the
        sensors, and if another host starts a reading at the same moment.
        """
        request = Measure(random_reading(), window, tuple(frequencies))
        started = await self._request(request, expect=Reading)
        _check_same(started, number=request.number, tones=len(request.frequencies))
        return started

    async def reading(self, first: int = 0) -> Reading:
        """Read the reading, its sensors from one on, as many as one reply holds."""
        return await self._request(GetReading(first), expect=Reading)

    async def raw_samples(self, sensor: int, sample: int = 0) -> SampleBlock:
        """Read raw samples [counts] of a sensor within the reading's window, from one on."""
        return await self._request(GetBlock(sensor, sample), expect=SampleBlock)

    async def measure(self, frequencies: Sequence[float], window: float) -> Reading:
        """Measure tones [Hz] at all sensors over a window [s] from now on, and wait for its end.

        Tones are in the order of the frequencies. The caller feeds the watchdog meanwhile, and has
        waited until the plate has settled. Raises CommandError for tones that the window does not
        tell apart, and what `start_reading` and `finish_reading` raise.
        """
        _check_tones(frequencies, window)
        return await self.finish_reading(await self.start_reading(frequencies, window))

    async def finish_reading(self, started: Reading) -> Reading:
        """Wait for the end of a reading, and return it with all its sensors.

        Raises CommandRefused if another host has started one meanwhile, and FrameError if it does
        not end in time or lacks sensors.
        """
        found = started
        end = clock.now() + started.left + _MAX_OVERDUE
        while found.state is ReadingState.RUNNING:
            if clock.now() > end:
                raise FrameError(
                    f"reading {started.number} must be complete after its window, got "
                    f"{found.state.name} {_MAX_OVERDUE:g} s later; {PROTOCOL_VIOLATION}"
                )
            await asyncio.sleep(found.left + _MARGIN)
            found = await self._same_reading(started)
        count = (await self._request(GetSensors(), expect=SensorList)).count
        sensors = found.sensors
        while len(sensors) < count:
            more = (await self._same_reading(started, len(sensors))).sensors
            if not more:
                break
            sensors += more
        if len(sensors) != count:
            raise FrameError(
                f"reading must have all {count} sensors, got {len(sensors)}; {PROTOCOL_VIOLATION}"
            )
        return replace(found, sensors=sensors)

    async def _same_reading(self, started: Reading, first: int = 0) -> Reading:
        """Read the reading that was started, its sensors from one on."""
        found = await self.reading(first)
        _check_same(found, number=started.number, tones=started.tone_count)
        return found


def _check_tones(frequencies: Sequence[float], window: float) -> None:
    """Raise CommandError for tones [Hz] that a window [s] does not tell apart."""
    limit = PROTOCOL.quantities.tone_count.maximum
    if not 1 <= len(frequencies) <= limit:
        raise CommandError(f"a reading must have 1 to {limit} tones, got {len(frequencies)}")
    apart = min(after - before for before, after in pairwise([0.0, *sorted(frequencies)]))
    if not apart * window >= 1 - _ROUNDING:
        raise CommandError(
            f"window must be at least a period of each frequency and of the differences between "
            f"them, 1/({apart:g} Hz), got {window:g} s"
        )


def _check_same(found: Reading, *, number: int, tones: int) -> None:
    """Raise CommandRefused for a reading of another number, FrameError for other tones."""
    if found.number != number:
        raise CommandRefused(
            f"reading {number} was replaced by {found.number or 'none'}: another host "
            "measures, or the amplifier has restarted; measure again"
        )
    seen = {found.tone_count, *(len(one.tones) for one in found.sensors)} - {tones}
    if seen:
        raise FrameError(
            f"reading {number} must have {tones} tones, got {min(seen)}; {PROTOCOL_VIOLATION}"
        )
