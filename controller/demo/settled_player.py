"""Plays excitations until they have settled, and reads the sensors of the amplifier meanwhile."""

import asyncio
import math
from collections.abc import Mapping

import numpy as np

from controller.group.amplifier_group import AmplifierGroup
from controller.group.guards import make_guards
from controller.loop.routing import commands_by_era, route
from drivers import clock
from drivers.amplifier import Amplifier
from drivers.command import DriveCommand
from drivers.errors import CommandRefused, LinkError
from drivers.guard import Guard
from drivers.operation.watchdog import HEARTBEAT
from drivers.protocol.definition import token_after
from drivers.protocol.messages import ReadingState
from model.arrays import ComplexArray
from model.rig.rig import Rig
from model.vibration.excitation import Excitation

RAMP = 0.05  # s
SETTLING = 0.7  # s; plain ramps leave little ringing after that


class SettledPlayer:
    """Drives the one amplifier of a rig; open and armed between `open` and `close`."""

    def __init__(self, rig: Rig, amplifiers: Mapping[str, Amplifier]) -> None:
        self._rig = rig
        ((self._name, self._amplifier),) = amplifiers.items()
        self._group = AmplifierGroup(amplifiers)
        self._guard: Guard | None = None
        self._channels: list[int | None] = []  # of the sensors
        self._token = 0

    async def open(self) -> None:
        """Open the amplifier, disarmed. Raises DriverError."""
        await self._group.open()
        self._guard = make_guards(self._rig, {self._name: self._amplifier})[self._name]
        self._channels = [sensor.channel for sensor in await self._amplifier.sensors()]

    async def arm(self) -> None:
        """Switch the high voltage on."""
        await self._group.arm()

    async def disarm(self) -> None:
        """Ramp to silence and switch the high voltage off."""
        await self._group.disarm()

    async def close(self) -> None:
        """End silent and disarmed."""
        silence = {}
        if self._guard is not None:
            numbers = [wired.number for wired in self._rig.wiring.values()]
            token = token_after(self._token)
            silence = {self._name: self._guard.silence(token, numbers, ramp=RAMP)}
        await self._group.close(silence)

    async def play(
        self, excitation: Excitation, *, window: float
    ) -> tuple[Mapping[str, DriveCommand], ComplexArray]:
        """Play an excitation, and read its tones over a window [s] once it has settled.

        What each driven ERA plays, and acceleration [m/s²] at the sensor of each ERA, by the tones
        of `tones_of` (s, f). Raises DriverError.
        """
        assert self._guard is not None  # noqa: S101  open
        self._token = token_after(self._token)
        routed = route(excitation, self._rig, token=self._token, ramp=RAMP)
        safe = {self._name: self._guard.check(routed[self._name])}
        played = await self._group.play(safe)
        if played is None:
            raise LinkError("demonstration aborted: the amplifier was silenced")
        plays = commands_by_era(played.achieved, self._rig)
        await self._wait(routed[self._name].ramp + SETTLING)
        reading = asyncio.create_task(self._amplifier.measure(tones_of(plays), window))
        while not reading.done():
            await asyncio.wait({reading}, timeout=HEARTBEAT)
            await self._group.heartbeat()
        found = reading.result()
        if found.state is not ReadingState.COMPLETE:
            raise CommandRefused("a reading was disturbed by a change of what plays")
        by_channel = dict(zip(self._channels, found.sensors, strict=True))
        feet = [by_channel[self._rig.wiring[era.name].number] for era in self._rig.eras]
        return plays, np.array([[tone.phasor for tone in foot.tones] for foot in feet])

    async def _wait(self, seconds: float) -> None:
        end = clock.now() + seconds
        while (left := end - clock.now()) > 1e-9:
            await asyncio.sleep(min(HEARTBEAT, left))
            await self._group.heartbeat()


def tones_of(plays: Mapping[str, DriveCommand]) -> list[float]:
    """Frequencies [Hz] of what plays, ascending."""
    return sorted({command.frequency for command in plays.values()})


def base_of(command: DriveCommand, stroke: float) -> complex:
    """Complex amplitude of the base [m] that a command moves over a stroke [m]."""
    phase = math.radians(command.phase)
    return command.level * stroke * complex(math.cos(phase), math.sin(phase))
