"""Reads the sensors of the plate once in every pattern that has settled.

A pattern has settled some time after its last fade and after the last change of the contacts. What
plays is never delayed for a reading: its requests go last on the line, and none is sent while
contacts change. A renewal disturbs a reading, which is then repeated.
"""

import asyncio
import cmath
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from controller.plate_measurement import PlateSensor
from controller.play.observer import PlayReport
from controller.sources.contacts import Contact
from drivers.errors import DriverError, Preempted
from drivers.host.amplifier import Amplifier, Reading, finish_reading, start_reading
from model.identification.forward import RestingFinger
from model.identification.settled_patterns import SettledPattern
from model.rig.rig import Rig
from registry import threads

WINDOW = 0.2  # s; of a reading, as in an identification
READINGS = 4  # of one pattern, at most, where others are disturbed
_MOVED = 0.003  # m; a finger that has moved by less loads the plate as before
_MARGIN = 0.002  # s; of the amplifiers' clocks
_PERIODS = 1.01  # of a tone within a window, for frequencies as amplifiers round them
_PAUSE_AFTER_FAILURE = 10.0  # s

_logger = logging.getLogger(__name__)


class SettledReadings:
    """Follows what the control loop reports, and reads it.

    sensors: of amplifiers, by name, of one time; settling [s]: of the plate; take: receives
    each pattern with what was read of it, at the time [s] when the window ended; disturbed: called
    for each reading that a change, an overload or the link has spoilt.
    """

    def __init__(
        self,
        rig: Rig,
        amplifiers: Mapping[str, Amplifier],
        sensors: Sequence[PlateSensor],
        *,
        settling: float,
        take: Callable[[SettledPattern], None],
        disturbed: Callable[[], None],
    ) -> None:
        self._rig, self._amplifiers, self._sensors = rig, amplifiers, sensors
        self._settling, self._take, self._disturbed = settling, take, disturbed
        self._highest = min(sensor.frequency_max for sensor in sensors)
        self._contacts: tuple[Contact, ...] = ()
        self._settled_contacts: tuple[Contact, ...] = ()
        self._playing: PlayReport | None = None
        self._due = math.inf
        self._change = asyncio.Event()

    def pattern_applied(self, applied: PlayReport) -> None:
        """Follow a pattern that the amplifiers have confirmed, if it can be read."""
        frequencies = {command.frequency for command in applied.drive.values()}
        is_one = len(applied.contents) == len(frequencies) == 1
        is_read = applied.lasts and is_one and max(frequencies) <= self._highest
        self._playing = applied if is_read else None
        self._contacts = applied.contacts
        self._wait_for(applied.time + applied.settled_after)

    def contacts_changed(self, contacts: tuple[Contact, ...]) -> None:
        """Follow the contacts; where they load the plate otherwise it settles anew."""
        self._contacts = contacts
        if not _are_same(contacts, self._settled_contacts):
            self._wait_for(threads.now())

    def ended(self) -> None:
        """Read no more of what played."""
        self._playing, self._due = None, math.inf
        self._change.set()

    async def run(self) -> None:
        """Read every pattern that settles, until cancelled."""
        while True:
            self._change.clear()
            if await self._changes_by(self._due):
                continue
            applied, contacts = self._playing, self._contacts
            self._due = math.inf
            if applied is None:
                continue
            try:
                await self._read(applied, contacts)
            except Preempted:
                self._disturbed()  # what preempted it is read once it has settled
            except DriverError as error:
                self._disturbed()
                _logger.info("reading given up: %s", error)
                await asyncio.sleep(_PAUSE_AFTER_FAILURE)

    def _wait_for(self, since: float) -> None:
        """Read a settling time after a moment [s] with the contacts of now."""
        self._settled_contacts = self._contacts
        self._due = math.inf if self._playing is None else since + self._settling
        self._change.set()

    async def _changes_by(self, moment: float) -> bool:
        """Wait for a change until a moment [s]; whether there was one."""
        timeout = None if math.isinf(moment) else max(0.0, moment - threads.now())
        try:
            async with asyncio.timeout(timeout):
                await self._change.wait()
        except TimeoutError:
            return False
        return True

    async def _read(self, applied: PlayReport, contacts: tuple[Contact, ...]) -> None:
        """Read a pattern until a reading was not disturbed; raises DriverError."""
        (frequency,) = {command.frequency for command in applied.drive.values()}
        for _ in range(READINGS):
            readings, ended_at = await self._measure(frequency)
            if self._change.is_set():
                self._disturbed()
                return
            if all(each.state == "COMPLETE" for each in readings.values()):
                break
        else:
            self._disturbed()
            return
        values = []
        for sensor in self._sensors:
            several = readings[sensor.amplifier].sensors
            if sensor.number >= len(several) or several[sensor.number].is_overloaded:
                self._disturbed()
                return
            reading = readings[sensor.amplifier]
            values.append(sensor.accelerations(reading, np.array([frequency]))[0])
        if not np.isfinite(values).all() or not np.any(values):  # no phase to turn others to
            self._disturbed()
            _logger.info("reading given up: all sensors read nothing")
            return
        tip = self._rig.fingertip
        fingers = [RestingFinger(c.x, c.y, tip.scaled(c.load)) for c in contacts if tip is not None]
        pattern = SettledPattern(
            ended_at,
            frequency,
            np.array(
                [
                    cmath.rect(tone.level * era.full_level, math.radians(tone.phase))
                    if (tone := applied.drive.get(era.name)) is not None
                    else 0j
                    for era in self._rig.eras
                ]
            ),
            np.array(values),
            tuple(fingers),
            has_phase=False,  # outputs follow their clocks by a delay that is not known
        )
        self._take(pattern)

    async def _measure(self, frequency: float) -> tuple[Mapping[str, Reading], float]:
        """Read a tone [Hz] at all amplifiers; the readings, and when [s] their window ended.

        Nothing is requested after a change meanwhile.
        """
        names = {sensor.amplifier for sensor in self._sensors}
        amplifiers = {name: self._amplifiers[name] for name in sorted(names)}
        window = max(WINDOW, _PERIODS / frequency)
        started = {
            name: await start_reading(each, [frequency], window)
            for name, each in amplifiers.items()
        }
        end = threads.now() + max(each.left for each in started.values())
        if await self._changes_by(end + _MARGIN):
            return started, end
        found = {
            name: await finish_reading(each, replace(started[name], left=0.0))
            for name, each in amplifiers.items()
        }
        return found, end


def _are_same(contacts: tuple[Contact, ...], before: tuple[Contact, ...]) -> bool:
    """Whether contacts load the plate as others did."""
    then = {contact.key: contact for contact in before}
    return len(contacts) == len(before) and all(
        contact.key in then
        and math.dist((contact.x, contact.y), (then[contact.key].x, then[contact.key].y)) <= _MOVED
        and contact.load == then[contact.key].load
        for contact in contacts
    )
