"""A synchronous amplifier for scripts.

    with BlockingAmplifier("serial:///dev/ttyUSB0", limits=GuardLimits(40, 500, 0.5)) as amplifier:
        amplifier.arm()
        amplifier.play([DriveCommand(channel=0, frequency=110, level=0.2)], duration=0.5)

Only `play`, while it waits, and `heartbeat` feed the watchdog: a script that hangs falls silent.
"""

import asyncio
import threading
from collections.abc import Coroutine, Mapping, Sequence
from types import MappingProxyType, TracebackType
from typing import Any, TypeVar

from drivers.amplifier import WATCHDOG, Amplifier
from drivers.command import CommandSet, DriveCommand, Envelope
from drivers.errors import CommandError
from drivers.guard import Guard, GuardLimits
from drivers.operation.checked_amplifier import CheckedAmplifier
from drivers.operation.keep_alive import keep_alive
from drivers.operation.watchdog import HEARTBEAT
from drivers.protocol.messages import (
    Achieved,
    AmplifierState,
    Capabilities,
    FaultRecord,
    Identity,
    Reading,
    Sensor,
    Status,
)
from drivers.registry import open_backend
from registry.voltage import VoltageDrive

_RAMP = 0.02  # s; long enough that neither start nor end of a vibration clicks

_T = TypeVar("_T")


class BlockingAmplifier:
    """The amplifier at a URL within limits, open while the context lasts.

    voltage: by channel, for an amplifier of voltage. Leaving the context disarms it. Raises what
    `Amplifier` raises.
    """

    def __init__(
        self,
        url: str,
        *,
        limits: GuardLimits,
        voltage: Mapping[int, VoltageDrive] = MappingProxyType({}),
    ) -> None:
        self._url = url
        self._voltage = voltage
        self._limits = limits
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name=f"amplifier {url}")

    def __enter__(self) -> "BlockingAmplifier":
        self._thread.start()
        try:
            self._amplifier = Amplifier(open_backend(self._url, self._voltage))
            self._wait(self._amplifier.open())
            self._checked = CheckedAmplifier(self._amplifier)
            self._guard = Guard(self._limits, self._amplifier.capabilities)
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        where: TracebackType | None,
    ) -> None:
        try:
            if not self._amplifier.is_lost:
                self._wait(self._amplifier.disarm())
        finally:
            try:
                self._wait(self._amplifier.close())
            finally:
                self._end()

    @property
    def identity(self) -> Identity:
        """Vendor, product, serial number and firmware."""
        return self._amplifier.identity

    @property
    def capabilities(self) -> Capabilities:
        """Frequency range, steps and channels."""
        return self._amplifier.capabilities

    def arm(self, watchdog: float = WATCHDOG) -> Status:
        """Switch the high voltage on, level zero; watchdog [s]."""
        return self._wait(self._checked.arm(watchdog))

    def disarm(self) -> Status:
        """Fall silent, then switch the high voltage off."""
        return self._wait(self._amplifier.disarm())

    def stop(self) -> Status:
        """Quick stop, latched until `clear`."""
        return self._wait(self._amplifier.stop())

    def clear(self) -> Status:
        """Acknowledge a stop or a fault."""
        return self._wait(self._amplifier.clear())

    def status(self) -> Status:
        """Read state, fault and levels."""
        return self._wait(self._amplifier.status())

    def faults(self) -> tuple[FaultRecord, ...]:
        """Read latched and past faults, newest first."""
        return self._wait(self._amplifier.faults())

    def sensors(self) -> tuple[Sensor, ...]:
        """Read what its sensors measure, and where; empty if it has none."""
        return self._wait(self._amplifier.sensors())

    def measure(self, frequencies: Sequence[float], window: float) -> Reading:
        """Measure tones [Hz] at all sensors over a window [s], feeding the watchdog meanwhile.

        What plays must have settled before. Raises CommandRefused if the amplifier stops by itself.
        """
        return self._wait(self._measured(frequencies, window))

    async def _measured(self, frequencies: Sequence[float], window: float) -> Reading:
        is_armed = (await self._amplifier.status()).state is AmplifierState.OPERATION_ENABLED
        measuring = asyncio.ensure_future(self._amplifier.measure(frequencies, window))
        try:
            while is_armed and not measuring.done():
                await asyncio.wait([measuring], timeout=HEARTBEAT)
                await self._checked.heartbeat()
            return await measuring
        finally:
            measuring.cancel()

    def heartbeat(self) -> Status:
        """Feed the watchdog."""
        return self._wait(self._amplifier.heartbeat())

    def load_envelope(self, envelope: Envelope) -> None:
        """Load an envelope for later sets."""
        self._wait(self._amplifier.load_envelope(self._guard.check_envelope(envelope)))

    def apply(
        self, commands: Sequence[DriveCommand], *, ramp: float = _RAMP, valid_for: float = 0.0
    ) -> Achieved:
        """Play these commands from now on, all other channels silent."""
        _require_commands(commands)
        command_set = CommandSet(
            token=self._amplifier.next_token(),
            commands=tuple(commands),
            ramp=ramp,
            valid_for=valid_for,
        )
        return self._wait(self._checked.apply(self._guard.check(command_set)))

    def play(
        self, commands: Sequence[DriveCommand], *, duration: float, ramp: float = _RAMP
    ) -> Achieved:
        """Play these commands for a time [s], feed the watchdog and wait for the end.

        Raises CommandRefused if the amplifier stops by itself, or its replies contradict requests.
        """
        achieved = self.apply(commands, ramp=ramp, valid_for=duration)
        self._wait(keep_alive(self._checked, duration, interval=HEARTBEAT))
        return achieved

    def _wait(self, work: Coroutine[Any, Any, _T]) -> _T:
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:  # also KeyboardInterrupt: nothing goes on feeding the watchdog
            future.cancel()
            raise

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


def _require_commands(commands: object) -> None:
    """Raise CommandError for anything but a sequence of drive commands."""
    if not (
        isinstance(commands, Sequence) and all(isinstance(one, DriveCommand) for one in commands)
    ):
        raise CommandError(
            f"commands must be a list of DriveCommand, got {type(commands).__name__}; pass those "
            'of one amplifier, as in commands_for(rig, pattern)["main"]'
        )
