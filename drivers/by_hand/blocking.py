"""A synchronous amplifier for scripts.

    with BlockingAmplifier("serial:///dev/ttyUSB0", limits=GuardLimits(40, 500, 0.5)) as amplifier:
        amplifier.arm()
        tone = Tone(channel=0, frequency=110, level=0.2)
        amplifier.play([AmplifierLayer(0, (tone,))], duration=0.5)

Only `play` and `measure`, while they wait, and `heartbeat` feed the watchdog: a script that hangs
falls silent.
"""

import asyncio
from collections.abc import Sequence
from contextlib import AsyncExitStack
from dataclasses import replace
from types import TracebackType
from typing import Any

from drivers.by_hand.reaching import (
    capability_rows,
    fault_rows,
    keep_alive,
    random_session,
    reached,
    status_rows,
)
from drivers.errors import CommandError, CommandRefused
from drivers.host.amplifier import WATCHDOG, Reading, Sensor, measure_tones, read_sensors
from drivers.host.dialogue import Staged, Stopped
from drivers.host.line import Priority
from drivers.playing.contents import Layer as AmplifierLayer
from drivers.protocol.definition import ENABLED, HEARTBEAT
from drivers.protocol.sets import token_after
from registry.limits import GuardLimits
from registry.threads import LoopThread


class BlockingAmplifier:
    """The amplifier at a URL within limits, open while the context lasts.

    is_output: what full level must be, the output of a linear amplifier or the motion of a stiff
    source; None for either. Leaving the context disarms it. Raises what `Amplifier` raises.
    """

    def __init__(self, url: str, *, limits: GuardLimits, is_output: bool | None = None) -> None:
        self._reached = reached(url, limits=limits, is_output=is_output)
        self._opened = AsyncExitStack()
        self._token = 1
        self._name = f"amplifier {url}"

    def __enter__(self) -> "BlockingAmplifier":
        self._loop = LoopThread(self._name)
        self._wait = self._loop.run  # interrupted, it cancels: nothing feeds the watchdog further
        try:
            self._amplifier = self._wait(self._opened.enter_async_context(self._reached))
            self._wait(self._amplifier.open())
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
            if self._amplifier.line.loss is None:
                self._wait(self._amplifier.disarm())
        finally:
            self._end()

    @property
    def identity(self) -> dict[str, Any]:
        """Vendor, product, serial number and firmware; versions as bits."""
        return {**self._amplifier.identity}

    @property
    def capabilities(self) -> dict[str, Any]:
        """Frequency range, steps and channels, with the keys of `era amp identify`."""
        return capability_rows(self._amplifier.capabilities)

    def arm(self, watchdog: float = WATCHDOG) -> dict[str, Any]:
        """Switch the high voltage on, level zero; watchdog [s]. Returns the status."""
        return status_rows(self._wait(self._amplifier.arm(random_session(), watchdog)))

    def disarm(self) -> None:
        """Fall silent, then switch the high voltage off."""
        self._wait(self._amplifier.disarm())

    def stop(self) -> None:
        """Quick stop, latched until `clear`; CommandRefused where silence is not confirmed."""
        stopped = self._wait(self._stopped())
        if not stopped.is_confirmed:
            raise CommandRefused(f"the amplifier may play: {stopped.cause}")

    def clear(self) -> dict[str, Any]:
        """Acknowledge a stop or a fault; returns the status."""
        return status_rows(self._wait(self._amplifier.clear()))

    def status(self) -> dict[str, Any]:
        """Read state, fault and levels, with the keys of `era amp status`."""
        return status_rows(self._wait(self._amplifier.request("GetStatus", {})))

    def faults(self) -> list[dict[str, Any]]:
        """Read latched and past faults, newest first, with the keys of `era amp status`."""
        return fault_rows(self._wait(self._amplifier.request("GetFaults", {})))

    def heartbeat(self) -> dict[str, Any]:
        """Feed the watchdog; CommandRefused if the amplifier is no longer armed."""
        values = {"session": self._amplifier.session, "rate": 0}
        return status_rows(self._wait(self._amplifier.request("Ping", values, Priority.HEARTBEAT)))

    def sensors(self) -> tuple[Sensor, ...]:
        """Read what its sensors measure, and where; empty if it has none."""
        return self._wait(read_sensors(self._amplifier))

    def measure(self, frequencies: Sequence[float], window: float) -> Reading:
        """Measure tones [Hz] at all sensors over a window [s], feeding the watchdog meanwhile.

        What plays must have settled before. Raises CommandRefused if the amplifier stops by itself.
        """
        return self._wait(self._measured(frequencies, window))

    def apply(self, layers: Sequence[AmplifierLayer]) -> Staged:
        """Play these layers from now on, all else silent; returns them as on the wire."""
        return self._wait(self._applied(layers))

    def play(self, layers: Sequence[AmplifierLayer], *, duration: float) -> Staged:
        """Play these layers for a time [s], feed the watchdog and wait for the end.

        Raises CommandRefused if the amplifier stops by itself, or its replies contradict requests.
        """
        _require_layers(layers)
        played = self.apply([replace(each, valid_for=duration) for each in layers])
        self._wait(keep_alive(self._amplifier, duration, HEARTBEAT))
        return played

    async def _applied(self, layers: Sequence[AmplifierLayer]) -> Staged:
        _require_layers(layers)
        self._token = token_after(self._token)
        every, given = range(self._amplifier.capabilities["layers"]), [n.number for n in layers]
        ended = [AmplifierLayer(number) for number in every if number not in given]
        return await self._amplifier.stage(self._token, [*layers, *ended], now=True)

    async def _stopped(self) -> Stopped:
        return await self._amplifier.stop()

    async def _measured(self, frequencies: Sequence[float], window: float) -> Reading:
        is_armed = (await self._amplifier.read_status())["state"] == ENABLED
        measuring = asyncio.ensure_future(measure_tones(self._amplifier, frequencies, window))
        try:
            while is_armed and not measuring.done():
                await asyncio.wait([measuring], timeout=HEARTBEAT)
                await self._amplifier.ping()
            return await measuring
        finally:
            measuring.cancel()

    def _end(self) -> None:
        try:
            self._wait(self._opened.aclose())
        finally:
            self._loop.close()


def _require_layers(layers: object) -> None:
    """Raise CommandError for anything but a sequence of layers."""
    if not (isinstance(layers, Sequence) and all(isinstance(n, AmplifierLayer) for n in layers)):
        raise CommandError(f"layers must be a list of AmplifierLayer, got {type(layers).__name__}")
