"""Stops of an amplifier, and bounds on its playback after them.

`PendingStop` repeats a stop until a status confirms it. `PlaybackBound` keeps what confirmed stops,
arming and clearing show about the end of playback; `AmplifierRecord.what_may_play` combines it with
the watchdog and the last status.
"""

import asyncio
import math
from dataclasses import dataclass, field
from typing import Protocol

from drivers.host.line import Line
from drivers.host.requests import Member, Priority
from drivers.protocol.definition import LATCHED, QUANTITIES, REPLY_TIMEOUT
from drivers.protocol.records import Values
from drivers.protocol.sets import is_newer_token
from registry import threads

CONFIRM_INTERVAL = 0.005  # s; between two attempts, in addition to the ramp
_RAMP = QUANTITIES["ramp"]


@dataclass(frozen=True, slots=True)
class StopOutcome:
    """What an amplifier may still play after a stop."""

    is_confirmed: bool
    """Whether the amplifier has confirmed that it is silent."""
    may_play_until: float
    """Until when it may play [s]; infinite if nothing is known to silence it."""
    cause: str = ""
    """Why no more is known."""


UNREACHED = StopOutcome(False, math.inf, "it has not replied since the start")
"""State of an amplifier before its first reply."""


@dataclass
class PlaybackBound:
    """Until when an amplifier may play, without the evidence of its watchdog and last status."""

    until: float = math.inf
    """In s; infinite before anything is known, -infinite if only the watchdog counts."""
    is_stopped: bool = False
    """Whether it has confirmed a stop and was sent no Clear or Arm since; no watchdog counts."""

    def note_stopped(self, now: float) -> None:
        """Note that the amplifier has confirmed a stop now [s]."""
        self.until = now
        self.is_stopped = True

    def note_cleared(self) -> None:
        """Note that a Clear is sent, after which it can be armed."""
        self.is_stopped = False

    def note_armed(self) -> None:
        """Note that an Arm is sent: from now on, the watchdog ends playback."""
        self.until = -math.inf
        self.is_stopped = False


class StoppableAmplifier(Member, Protocol):
    """The amplifier of a stop."""

    line: Line
    latch: int | None

    def is_silent(self, status: Values) -> bool:
        """Whether a status shows the levels of all channels, all zero."""

    def read_status(self, priority: Priority) -> "asyncio.Future[Values]":
        """Read the status."""

    async def identify(self, *, timeout: float) -> Values:
        """Read identity and capabilities, and return the status; timeout: for each reply [s]."""


@dataclass(eq=False, slots=True)
class PendingStop:
    """A stop, which is repeated until the amplifier has confirmed it or a timeout has passed."""

    amplifier: StoppableAmplifier
    ramp: int
    """In units of the wire."""
    timeout: float
    """Time for which it is repeated after the first request [s]."""
    ends_at: float
    """Time of the timeout [s]."""
    is_sent: bool = False
    """Whether the first request has been sent; later playback needs another stop."""
    is_confirmed: bool = False
    """Whether a status has confirmed it."""
    outcome: "asyncio.Future[StopOutcome]" = field(init=False)
    _queued: "asyncio.Future[Values] | None" = None
    """The first request, which was queued as soon as the stop was requested."""
    _latch: int | None = None
    """The newest latch that was known when the last request was queued."""
    _limit: asyncio.Timeout | None = None
    """Ends `repeat`; None before that, when only `ends_at` is set."""

    def queue(self) -> None:
        """Queue the first request now."""
        self._queued = self._request()

    def _request(self) -> "asyncio.Future[Values]":
        """Queue a request; returns a future of the status."""
        self._latch = self.amplifier.latch
        line = self.amplifier.line
        return line.submit(self.amplifier, Priority.STOP, "Stop", self._start_timeout)

    def _start_timeout(self) -> list[Values]:
        """Return the values of a request that is sent now; the first one starts the timeout."""
        if not self.is_sent:
            self.is_sent = True
            self.ends_at = threads.now() + self.timeout
            if self._limit is not None:
                self._limit.reschedule(self.ends_at)
        return [{"ramp": self.ramp}]

    async def repeat(self) -> str:
        """Repeat the request until it is confirmed, or the timeout has passed, or the line is lost.

        Returns why it is not confirmed, or nothing.
        """
        cause = ""
        pause = _RAMP.from_wire(self.ramp) + CONFIRM_INTERVAL
        line = self.amplifier.line
        try:
            async with asyncio.timeout_at(self.ends_at) as self._limit:
                while line.loss is None:
                    try:
                        if await self._is_confirmed_by_request():
                            self.is_confirmed = True
                            return ""
                    except Exception as error:  # the stop continues after any failure
                        cause = str(error) or type(error).__name__
                    await asyncio.sleep(pause)
        except TimeoutError:
            cause = cause or f"silence was not reported within {self.timeout:g} s"
        return line.loss or cause

    async def _is_confirmed_by_request(self) -> bool:
        """Await a request, and statuses until one confirms the stop or shows that it cannot.

        A status confirms it if its state is latched, its latch is newer than each one seen before,
        and the levels of all channels are zero. Any other status may be old and only late. An older
        latch can also show a power-up, after which latches count from 1: the amplifier is then
        identified again, and the next request is compared with its new latch.
        """
        request = self._queued
        self._queued = None
        status = await (request or self._request())
        if _is_restarted(status, self._latch):
            await self.amplifier.identify(timeout=REPLY_TIMEOUT)
            return False
        while _is_stopping(status, self._latch):
            if self.amplifier.is_silent(status):
                return True
            await asyncio.sleep(CONFIRM_INTERVAL)
            status = await self.amplifier.read_status(Priority.STOP)
        return False


def _is_restarted(status: Values, last_latch: int | None) -> bool:
    """Whether a status shows a stop, but an older latch than was known."""
    latch = status["latch"]
    if last_latch is None or status["state"] not in LATCHED or latch == last_latch:
        return False
    return not is_newer_token(latch, last_latch)


def _is_stopping(status: Values, last_latch: int | None) -> bool:
    """Whether a status shows a stop that was carried out after this latch was the newest."""
    if last_latch is None or status["state"] not in LATCHED:
        return False
    return status["latch"] > 0 and is_newer_token(status["latch"], last_latch)
