"""Plays excitations until they have settled, and reads the sensors of the plate meanwhile."""

import asyncio
import math
from collections.abc import Mapping, Sequence

import numpy as np

from controller.diagnosis.plate_sensors import PlateSensor, plate_sensors
from controller.diagnosis.tone_player import TonePlayer
from drivers import clock
from drivers.amplifier import Amplifier
from drivers.command import DriveCommand
from drivers.errors import CommandRefused
from drivers.operation.watchdog import HEARTBEAT
from drivers.protocol.messages import ReadingState
from model.arrays import ComplexArray
from model.identification.forward import Sensor
from model.rig.rig import Rig
from model.vibration.excitation import Excitation

SETTLING = 0.7  # s; plain ramps leave little ringing after that


class SettledPlayer:
    """Drives the one amplifier of a rig; open and armed between `open` and `close`."""

    def __init__(self, rig: Rig, amplifiers: Mapping[str, Amplifier]) -> None:
        ((_, self._amplifier),) = amplifiers.items()
        self._rig, self._amplifiers = rig, amplifiers
        self._player = TonePlayer(rig, amplifiers)
        self._sensors: Sequence[PlateSensor] = ()

    @property
    def sensors(self) -> list[Sensor]:
        """Where its sensors are; known once open."""
        return [each.place for each in self._sensors]

    async def open(self) -> None:
        """Open the amplifier, disarmed. Raises DriverError."""
        await self._player.open()
        self._sensors = (await plate_sensors(self._rig, self._amplifiers)).used

    async def arm(self) -> None:
        """Switch the high voltage on."""
        await self._player.arm()

    async def disarm(self) -> None:
        """Ramp to silence and switch the high voltage off."""
        await self._player.disarm()

    async def close(self) -> None:
        """End silent and disarmed."""
        await self._player.close()

    async def play(
        self, excitation: Excitation, *, window: float
    ) -> tuple[Mapping[str, DriveCommand], ComplexArray]:
        """Play an excitation, and read its tones over a window [s] once it has settled.

        What each driven ERA plays, and acceleration [m/s²] at the sensors by the tones of
        `tones_of` (s, f). Raises DriverError.
        """
        plays = await self._player.play(excitation)
        await self._wait(self._player.ramp + SETTLING)
        tones = tones_of(plays)
        reading = asyncio.create_task(self._amplifier.measure(tones, window))
        while not reading.done():
            await asyncio.wait({reading}, timeout=HEARTBEAT)
            await self._player.heartbeat()
        found = reading.result()
        if found.state is not ReadingState.COMPLETE:
            raise CommandRefused("a reading was disturbed by a change of what plays")
        frequencies = np.array(tones)
        heard = [sensor.accelerations(found, frequencies) for sensor in self._sensors]
        return plays, np.array(heard)

    async def _wait(self, seconds: float) -> None:
        end = clock.now() + seconds
        while (left := end - clock.now()) > 1e-9:
            await asyncio.sleep(min(HEARTBEAT, left))
            await self._player.heartbeat()


def tones_of(plays: Mapping[str, DriveCommand]) -> list[float]:
    """Frequencies [Hz] of what plays, ascending."""
    return sorted({command.frequency for command in plays.values()})


def base_of(command: DriveCommand, stroke: float) -> complex:
    """Complex amplitude of the base [m] that a command moves over a stroke [m]."""
    phase = math.radians(command.phase)
    return command.level * stroke * complex(math.cos(phase), math.sin(phase))
