"""An amplifier for scripts that are not asynchronous: the same calls, each waiting for its end.

    with BlockingAmplifier("serial:///dev/ttyUSB0", limits=GuardLimits(40, 500, 0.5)) as amplifier:
        amplifier.arm()
        amplifier.play([DriveCommand(channel=0, frequency=110, level=0.2)], duration=0.5)

The watchdog is fed by `play` while it waits, and by nothing else: a script that hangs is silent.
"""

import asyncio
import threading
import time
from collections.abc import Coroutine, Sequence
from types import TracebackType
from typing import Any, TypeVar

from drivers.amplifier import WATCHDOG, Amplifier
from drivers.command import CommandSet, DriveCommand, Envelope
from drivers.errors import CommandError, CommandRefused
from drivers.guard import Guard, GuardLimits
from drivers.operation.watchdog import HEARTBEAT
from drivers.protocol.messages import (
    Achieved,
    AmplifierState,
    Capabilities,
    FaultRecord,
    Identity,
    Status,
)
from drivers.registry import open_backend

_RAMP = 0.02  # s; neither start nor end of a vibration clicks

_T = TypeVar("_T")


class BlockingAmplifier:
    """The amplifier of a URL within these limits, open as long as the context lasts.

    Leaving the context disarms it. Raises what `Amplifier` raises.
    """

    def __init__(self, url: str, *, limits: GuardLimits) -> None:
        if not isinstance(url, str):
            raise CommandError(
                "the URL of an amplifier is text, such as serial:///dev/ttyUSB0, not a "
                f"{type(url).__name__}"
            )
        if not isinstance(limits, GuardLimits):
            raise CommandError(
                f"limits is a {type(limits).__name__}; give GuardLimits with the lowest and the "
                "highest frequency [Hz] and the highest level, such as GuardLimits(40, 500, 0.5)"
            )
        self._url = url
        self._limits = limits
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name=f"amplifier {url}")

    def __enter__(self) -> "BlockingAmplifier":
        self._thread.start()
        try:
            self._amplifier = self._wait(self._open())
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
        """Who it is."""
        return self._amplifier.identity

    @property
    def capabilities(self) -> Capabilities:
        """What it can play."""
        return self._amplifier.capabilities

    def arm(self, watchdog: float = WATCHDOG) -> Status:
        """High voltage on, level zero; watchdog [s]."""
        return self._wait(self._amplifier.arm(watchdog))

    def disarm(self) -> Status:
        """Silent, then high voltage off."""
        return self._wait(self._amplifier.disarm())

    def stop(self) -> Status:
        """Quick stop, latched until `clear`."""
        return self._wait(self._amplifier.stop())

    def clear(self) -> Status:
        """Acknowledge a stop or a fault."""
        return self._wait(self._amplifier.clear())

    def status(self) -> Status:
        """How it is."""
        return self._wait(self._amplifier.status())

    def faults(self) -> tuple[FaultRecord, ...]:
        """Latched and past faults, newest first."""
        return self._wait(self._amplifier.faults())

    def heartbeat(self) -> Status:
        """Feed the watchdog."""
        return self._wait(self._amplifier.heartbeat())

    def load_envelope(self, envelope: Envelope) -> None:
        """Keep an envelope for the sets to come."""
        self._wait(self._amplifier.load_envelope(self._guard.check_envelope(envelope)))

    def apply(
        self, commands: Sequence[DriveCommand], *, ramp: float = _RAMP, valid_for: float = 0.0
    ) -> Achieved:
        """Play these commands from now on, all others silent; returns what is achieved."""
        _expect_commands(commands)
        safe = self._guard.check(
            CommandSet(
                token=self._amplifier.next_token(),
                commands=tuple(commands),
                ramp=ramp,
                valid_for=valid_for,
            )
        )
        return self._wait(self._amplifier.apply(safe))

    def play(
        self, commands: Sequence[DriveCommand], *, duration: float, ramp: float = _RAMP
    ) -> Achieved:
        """Play these commands for a while [s] and wait for the end; feeds the watchdog.

        Raises CommandRefused where the amplifier has stopped by itself.
        """
        achieved = self.apply(commands, ramp=ramp, valid_for=duration)
        end = time.monotonic() + duration
        while (left := end - time.monotonic()) > 0:
            time.sleep(min(left, HEARTBEAT))
            status = self.heartbeat()
            if status.state is not AmplifierState.OPERATION_ENABLED:
                raise CommandRefused(
                    f"the amplifier stopped by itself: it is in {status.state.name}, fault "
                    f"{status.fault.name}; once the cause is gone, clear() it and arm() again"
                )
        return achieved

    async def _open(self) -> Amplifier:
        amplifier = Amplifier(open_backend(self._url))
        await amplifier.open()
        return amplifier

    def _wait(self, work: Coroutine[Any, Any, _T]) -> _T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


def _expect_commands(given: object) -> None:
    """Raise CommandError for what are no drive commands, those of all amplifiers by name say."""
    if not isinstance(given, Sequence) or not all(isinstance(one, DriveCommand) for one in given):
        raise CommandError(
            f"what shall be played is a {type(given).__name__}, not a list of DriveCommand; give "
            'those of one amplifier, as in commands_for(rig, pattern)["main"]'
        )
